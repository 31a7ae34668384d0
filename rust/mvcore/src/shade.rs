//! Colours of a textured mesh in some views: Lambert and Blinn-Phong under one lamp, and what surrounds the scene mirrored in
//! what shines, for the procedural training scenes.
//!
//! Deferred: the z-buffer of the enlarged view says which face each sample sees; the sample's place on the face gives texture
//! coordinates and a normal. Textures repeat and are read from the level of a box pyramid that fits the face's size on the
//! image; `samples`² samples a pixel are averaged, but inside a surface one in their middle does for all.

use crate::error::{Result, require};
use crate::interrupt::Interrupt;
use crate::mesh::{Mesh, NOTHING, project};
use crate::rasterize::rasterize;
use nalgebra::{Matrix3, Vector3};
use rayon::prelude::*;

/// What covers a mesh.
#[derive(Debug, Clone, Copy)]
pub struct Surface<'a> {
    /// Texture coordinates a vertex, in tiles: 1 is once across the texture.
    pub uv: &'a [[f32; 2]],
    /// Unit normals a vertex.
    pub normals: &'a [[f32; 3]],
    /// The material of each face.
    pub materials: &'a [u16],
    /// A square RGB texture a material, `size * size * 3` bytes each, and one more: the surroundings, an octahedral map.
    pub textures: &'a [u8],
    /// Texels a side, a power of two.
    pub size: usize,
    /// Ambient, diffuse and specular share, the shininess, and the share of the surroundings mirrored head-on, a material.
    pub gloss: &'a [[f32; 5]],
}

/// Views of the scene, all of one size.
#[derive(Debug, Clone, Copy)]
pub struct Shots<'a> {
    /// Row-major 3x4 K [R | t] each.
    pub projections: &'a [[f64; 12]],
    /// The lamp's place in the world.
    pub lamp: [f64; 3],
    /// Pixels.
    pub width: usize,
    /// Pixels.
    pub height: usize,
    /// Samples a pixel along each axis.
    pub samples: usize,
}

/// RGB images (views, height, width, 3); black where nothing is hit.
pub fn shade(mesh: Mesh, surface: Surface, shots: &Shots) -> Result<Vec<u8>> {
    check(mesh, surface, shots)?;
    let pyramid = Pyramid::new(surface.textures, surface.size);
    let mut images = vec![0u8; shots.projections.len() * shots.width * shots.height * 3];
    let views = images.chunks_exact_mut(shots.width * shots.height * 3);
    for (projection, image) in shots.projections.iter().zip(views) {
        shade_one(mesh, surface, &pyramid, projection, shots, image)?;
    }
    Ok(images)
}

fn shade_one(
    mesh: Mesh,
    surface: Surface,
    pyramid: &Pyramid,
    projection: &[f64; 12],
    shots: &Shots,
    image: &mut [u8],
) -> Result<()> {
    let n = shots.samples;
    let (width, height) = (shots.width * n, shots.height * n);
    let enlarged = enlarge(projection, n as f64);
    let (depth, hit) = rasterize(mesh, &enlarged, width, height)?;
    let level: Vec<u8> = (0..mesh.faces.len())
        .into_par_iter()
        .map(|f| fitting_level(mesh, surface, &enlarged, f, pyramid.levels))
        .collect();
    let m = Matrix3::from_fn(|r, c| enlarged[4 * r + c]);
    let p4 = Vector3::new(enlarged[3], enlarged[7], enlarged[11]);
    let inverse = m.try_inverse().unwrap_or_else(Matrix3::identity);
    let eye = -(inverse * p4);
    let place = |x: usize, y: usize, z: f32| {
        let pixel = Vector3::new(x as f64, y as f64, 1.0);
        inverse * (pixel * f64::from(z) - p4)
    };
    let interrupt = Interrupt::current();
    image.par_chunks_mut(shots.width * 3).enumerate().for_each(|(y, row)| {
        interrupt.poll();
        let mut samples = Vec::with_capacity(n * n);
        for x in 0..shots.width {
            samples.clear();
            for j in y * n..(y + 1) * n {
                for i in x * n..(x + 1) * n {
                    let at = j * width + i;
                    if hit[at] != NOTHING {
                        samples.push((hit[at] as usize, place(i, j, depth[at]), depth[at]));
                    }
                }
            }
            let lit =
                |level: u8, face: usize, place| light(mesh, surface, pyramid, level, face, place, eye, shots.lamp);
            let sum: Vector3<f32> = if samples.len() == n * n && one_surface(&samples, surface.materials) {
                let middle = samples.iter().map(|s| s.1).sum::<Vector3<f64>>() / (n * n) as f64;
                let coarser = (level[samples[0].0] + n.ilog2() as u8).min(pyramid.levels - 1);
                lit(coarser, samples[0].0, middle) * (n * n) as f32
            } else {
                samples.iter().map(|&(face, place, _)| lit(level[face], face, place)).sum()
            };
            for c in 0..3 {
                row[3 * x + c] = (sum[c] / (n * n) as f32).round().clamp(0.0, 255.0) as u8;
            }
        }
    });
    Ok(())
}

/// Whether a pixel's samples (face, place, depth) lie on one material, about side by side: then one light in the middle does for all.
fn one_surface(samples: &[(usize, Vector3<f64>, f32)], materials: &[u16]) -> bool {
    let (face, _, z) = samples[0];
    samples[1..].iter().all(|s| materials[s.0] == materials[face] && (s.2 - z).abs() < SIDE_BY_SIDE * z)
}

/// Share of its depth by which a pixel's samples may differ.
const SIDE_BY_SIDE: f32 = 0.01;

fn check(mesh: Mesh, surface: Surface, shots: &Shots) -> Result<()> {
    let (vertices, faces, kinds) = (mesh.vertices.len(), mesh.faces.len(), surface.gloss.len());
    require(surface.uv.len() == vertices, "uv", format!("{vertices}, one a vertex"), surface.uv.len())?;
    require(surface.normals.len() == vertices, "normals", format!("{vertices}, one a vertex"), surface.normals.len())?;
    require(surface.materials.len() == faces, "materials", format!("{faces}, one a face"), surface.materials.len())?;
    let worst = surface.materials.iter().copied().max().unwrap_or(0) as usize;
    require(faces == 0 || worst < kinds, "materials", format!("numbers below {kinds}"), worst)?;
    require(surface.size.is_power_of_two(), "textures", "a power of two texels a side", surface.size)?;
    let bytes = surface.size * surface.size * 3 * (kinds + 1);
    require(surface.textures.len() == bytes, "textures", format!("{bytes} bytes"), surface.textures.len())?;
    require(
        shots.width > 0 && shots.height > 0,
        "size",
        "a non-empty image",
        format!("{} x {}", shots.height, shots.width),
    )?;
    require((1..=8).contains(&shots.samples), "samples", "1 to 8", shots.samples)
}

/// The projection onto an image of n x n samples a pixel.
fn enlarge(p: &[f64; 12], n: f64) -> [f64; 12] {
    std::array::from_fn(|k| if k < 8 { n * p[k] + 0.5 * (n - 1.0) * p[8 + k % 4] } else { p[k] })
}

/// All textures at sizes `size`, `size / 2`, … 1, level by level.
struct Pyramid {
    texels: Vec<Vec<u8>>,
    size: usize,
    levels: u8,
}

impl Pyramid {
    fn new(textures: &[u8], size: usize) -> Self {
        let mut texels = vec![textures.to_vec()];
        let mut side = size;
        while side > 1 {
            let above = &texels[texels.len() - 1];
            let half = side / 2;
            let count = above.len() / (side * side * 3);
            let mut level = vec![0u8; count * half * half * 3];
            level.par_chunks_mut(half * 3).enumerate().for_each(|(row, out)| {
                let first = (row / half * side + row % half * 2) * side * 3;
                for (x, value) in out.iter_mut().enumerate() {
                    let at = first + x / 3 * 6 + x % 3;
                    let four = [at, at + 3, at + side * 3, at + side * 3 + 3].map(|k| u16::from(above[k]));
                    *value = ((four.iter().sum::<u16>() + 2) / 4) as u8;
                }
            });
            texels.push(level);
            side = half;
        }
        let levels = texels.len() as u8;
        Self { texels, size, levels }
    }

    /// Bilinear, repeating.
    fn at(&self, level: u8, texture: usize, uv: [f32; 2]) -> Vector3<f32> {
        let side = self.size >> level;
        let base = texture * side * side * 3;
        let [u, v] = uv.map(|c| (c - c.floor()) * side as f32 - 0.5);
        let (fu, fv) = (u - u.floor(), v - v.floor());
        // The side is a power of two.
        let wrap = |c: f32, k: i32| (c.floor() as i32 + k) as usize & (side - 1);
        let texel = |j: usize, i: usize| {
            let at = base + (j * side + i) * 3;
            Vector3::from_fn(|c, _| f32::from(self.texels[level as usize][at + c]))
        };
        let (x0, x1, y0, y1) = (wrap(u, 0), wrap(u, 1), wrap(v, 0), wrap(v, 1));
        (texel(y0, x0) * (1.0 - fu) + texel(y0, x1) * fu) * (1.0 - fv)
            + (texel(y1, x0) * (1.0 - fu) + texel(y1, x1) * fu) * fv
    }
}

/// The level whose texels are about as large as the samples on this face.
fn fitting_level(mesh: Mesh, surface: Surface, projection: &[f64; 12], face: usize, levels: u8) -> u8 {
    let corners = mesh.faces[face].map(|v| v as usize);
    let [a, b, c] = corners.map(|v| project(projection, mesh.vertices[v]));
    let [s, t, r] = corners.map(|v| surface.uv[v].map(f64::from));
    let area =
        |p: [f64; 2], q: [f64; 2], o: [f64; 2]| ((q[0] - p[0]) * (o[1] - p[1]) - (q[1] - p[1]) * (o[0] - p[0])).abs();
    let pixels = area([a[0], a[1]], [b[0], b[1]], [c[0], c[1]]);
    let texels = area(s, t, r) * (surface.size * surface.size) as f64;
    let level = 0.5 * (texels / pixels.max(1e-9)).max(1.0).log2();
    level.round().clamp(0.0, f64::from(levels - 1)) as u8
}

fn light(
    mesh: Mesh,
    surface: Surface,
    pyramid: &Pyramid,
    level: u8,
    face: usize,
    place: Vector3<f64>,
    eye: Vector3<f64>,
    lamp: [f64; 3],
) -> Vector3<f32> {
    let corners = mesh.faces[face].map(|v| v as usize);
    let weights = barycentric(mesh.corners(face).map(Vector3::from), place);
    let blend = |value: [f32; 3]| (0..3).map(|k| weights[k] * value[k]).sum::<f32>();
    let uv = [0, 1].map(|c| blend(corners.map(|v| surface.uv[v][c])));
    let normal = Vector3::from_fn(|c, _| blend(corners.map(|v| surface.normals[v][c])));
    let (normal, to_eye) = (normal.normalize(), (eye - place).normalize().cast::<f32>());
    // Surfaces have two sides.
    let normal = if normal.dot(&to_eye) < 0.0 { -normal } else { normal };
    let to_lamp = (Vector3::from(lamp) - place).normalize().cast::<f32>();
    let kind = surface.materials[face] as usize;
    let [ambient, diffuse, specular, shininess, mirror] = surface.gloss[kind];
    let facing = normal.dot(&to_eye);
    let mut colour = pyramid.at(level, kind, uv) * (ambient + diffuse * normal.dot(&to_lamp).max(0.0));
    if mirror > 0.0 {
        // Schlick: what shines mirrors more, the flatter it is looked at.
        let share = mirror + (1.0 - mirror) * (1.0 - facing.clamp(0.0, 1.0)).powi(5);
        let seen = octahedral(normal * (2.0 * facing) - to_eye);
        // A lobe is about shininess^-1/2 wide; the map's side spans half a turn.
        let texels = surface.size as f32 / (std::f32::consts::PI * shininess.max(1.0).sqrt());
        let blur = (texels.max(1.0).log2().round() as u8).min(pyramid.levels - 1);
        colour = colour * (1.0 - share) + pyramid.at(blur, surface.gloss.len(), seen) * share;
    }
    if specular > 0.0 {
        let half = (to_lamp + to_eye).normalize();
        colour = colour.add_scalar(255.0 * specular * normal.dot(&half).max(0.0).powf(shininess));
    }
    colour
}

/// Where a direction stands in an octahedral map of the surroundings, 0 .. 1 each.
fn octahedral(direction: Vector3<f32>) -> [f32; 2] {
    let d = direction / direction.lp_norm(1).max(1e-12);
    let folded =
        if d.z >= 0.0 { [d.x, d.y] } else { [(1.0 - d.y.abs()).copysign(d.x), (1.0 - d.x.abs()).copysign(d.y)] };
    folded.map(|c| 0.5 + 0.5 * c)
}

/// Weights of a triangle's corners at a point of its plane.
fn barycentric([a, b, c]: [Vector3<f64>; 3], p: Vector3<f64>) -> [f32; 3] {
    let normal = (b - a).cross(&(c - a));
    let square = normal.norm_squared().max(1e-300);
    let v = normal.dot(&(p - a).cross(&(c - a))) / square;
    let w = normal.dot(&(b - a).cross(&(p - a))) / square;
    [(1.0 - v - w) as f32, v as f32, w as f32]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A square of one material, under a texture, amid grey surroundings.
    fn square(gloss: [f32; 5], texture: &[u8], size: usize) -> Vec<u8> {
        let textures = [texture, &vec![SURROUNDINGS; texture.len()]].concat();
        let vertices = [[-1., -1., 2.], [1., -1., 2.], [1., 1., 2.], [-1., 1., 2.]];
        let mesh = Mesh::new(&vertices, &[[0, 1, 2], [0, 2, 3]]).unwrap();
        let surface = Surface {
            uv: &[[0., 0.], [1., 0.], [1., 1.], [0., 1.]],
            normals: &[[0., 0., -1.]; 4],
            materials: &[0, 0],
            textures: &textures,
            size,
            gloss: &[gloss],
        };
        let projections = &[[8., 0., 7.5, 0., 0., 8., 7.5, 0., 0., 0., 1., 0.]; 2];
        let shots = Shots { projections, lamp: [0., 0., -50.], width: 16, height: 16, samples: 2 };
        let images = shade(mesh, surface, &shots).unwrap();
        let (one, two) = images.split_at(16 * 16 * 3);
        assert_eq!(one, two);
        one.to_vec()
    }

    const SURROUNDINGS: u8 = 90;

    #[test]
    fn what_shines_mirrors_the_surroundings_more_the_flatter_it_is_seen() {
        let image = square([1.0, 0.0, 0.0, 30.0, 0.5], &[200; 12], 2);
        let at = |x: usize, y: usize| image[(y * 16 + x) * 3];
        assert!((i32::from(at(8, 8)) - 145).abs() <= 1, "{}", at(8, 8));
        assert!(at(4, 4) < at(8, 8) + 1 && at(4, 4) > SURROUNDINGS);
        assert_eq!(square([1.0, 0.0, 0.0, 30.0, 1.0], &[200; 12], 2)[(8 * 16 + 8) * 3], SURROUNDINGS);
    }

    #[test]
    fn directions_cover_the_octahedral_map() {
        let place = |x: f32, y: f32, z: f32| octahedral(Vector3::new(x, y, z));
        assert_eq!(place(0.0, 0.0, 3.0), [0.5, 0.5]);
        assert_eq!(place(2.0, 0.0, 0.0), [1.0, 0.5]);
        assert_eq!(place(0.0, -1.0, 0.0), [0.5, 0.0]);
        assert_eq!(place(1.0, 1.0, -2.0), [0.875, 0.875]);
    }

    #[test]
    fn an_ambient_surface_shows_its_texture() {
        // The square covers the pixels 3.5 to 11.5: a texel of the 4 x 4 texture is two pixels wide.
        let texture: Vec<u8> = (0..48).map(|k| (k * 5) as u8).collect();
        let image = square([1.0, 0.0, 0.0, 1.0, 0.0], &texture, 4);
        assert_eq!(image[..3], [0, 0, 0]);
        let at = |x: usize, y: usize| image[(y * 16 + x) * 3];
        for (x, y) in [(1, 1), (2, 1), (1, 2), (2, 2)] {
            let mean = [0, 1]
                .map(|j| [0, 1].map(|i| f64::from(at(4 + 2 * x + i, 4 + 2 * y + j))))
                .as_flattened()
                .iter()
                .sum::<f64>()
                / 4.0;
            assert!((mean - f64::from(texture[(y * 4 + x) * 3])).abs() < 8.0, "{mean}");
        }
    }

    #[test]
    fn a_lamp_straight_ahead_gives_full_diffuse_light() {
        let image = square([0.0, 0.5, 0.0, 1.0, 0.0], &[200; 12], 2);
        assert!((i32::from(image[(8 * 16 + 8) * 3]) - 100).abs() <= 1);
    }

    #[test]
    fn wrong_counts_are_named() {
        let mesh = Mesh::new(&[[0.; 3]; 3], &[[0, 1, 2]]).unwrap();
        let surface = Surface {
            uv: &[],
            normals: &[[0., 0., 1.]; 3],
            materials: &[0],
            textures: &[0; 6],
            size: 1,
            gloss: &[[1.; 5]],
        };
        let shots = Shots { projections: &[[0.; 12]], lamp: [0.; 3], width: 4, height: 4, samples: 1 };
        assert!(shade(mesh, surface, &shots).unwrap_err().to_string().starts_with("uv:"));
    }
}
