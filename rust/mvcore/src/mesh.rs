//! Nouns and small helpers for triangle meshes: borrowed vertices and faces, projection, neighbours across edges.

use crate::error::{Result, require};
use rayon::prelude::*;

/// No neighbour, no face, no label.
pub const NOTHING: i32 = -1;

/// A borrowed triangle mesh.
#[derive(Debug, Clone, Copy)]
pub struct Mesh<'a> {
    /// Positions in world units.
    pub vertices: &'a [[f64; 3]],
    /// Triples of vertex numbers.
    pub faces: &'a [[u32; 3]],
}

impl<'a> Mesh<'a> {
    /// Borrows a mesh whose faces all name existing vertices.
    pub fn new(vertices: &'a [[f64; 3]], faces: &'a [[u32; 3]]) -> Result<Self> {
        let n = vertices.len();
        let worst = faces.par_iter().map(|f| f[0].max(f[1]).max(f[2])).max();
        require(
            worst.is_none_or(|v| (v as usize) < n),
            "faces",
            format!("vertex numbers below {n}"),
            worst.unwrap_or_default(),
        )?;
        require(faces.len() < 1 << 30, "faces", "fewer than 2^30", faces.len())?;
        Ok(Self { vertices, faces })
    }

    /// The corners of a face.
    #[inline(always)]
    pub fn corners(&self, face: usize) -> [[f64; 3]; 3] {
        self.faces[face].map(|v| self.vertices[v as usize])
    }

    /// Normal of a face, its length twice the area.
    #[inline(always)]
    pub fn normal(&self, face: usize) -> [f64; 3] {
        normal(self.corners(face))
    }
}

/// Normal of a triangle, its length twice the area.
#[inline(always)]
pub fn normal([a, b, c]: [[f64; 3]; 3]) -> [f64; 3] {
    let u: [f64; 3] = std::array::from_fn(|k| b[k] - a[k]);
    let v: [f64; 3] = std::array::from_fn(|k| c[k] - a[k]);
    [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]]
}

/// Pixel and z-depth of a world point under P = K [R | t] (row-major 3x4).
#[inline(always)]
pub fn project(m: &[f64; 12], p: [f64; 3]) -> [f64; 3] {
    let q: [f64; 3] =
        std::array::from_fn(|r| m[4 * r] * p[0] + m[4 * r + 1] * p[1] + m[4 * r + 2] * p[2] + m[4 * r + 3]);
    [q[0] / q[2], q[1] / q[2], q[2]]
}

/// For each face the faces beyond its edges (0-1, 1-2, 2-0), [`NOTHING`] at a border or where three or more meet.
pub fn neighbours(faces: &[[u32; 3]]) -> Vec<[i32; 3]> {
    let end = faces.par_iter().map(|f| f[0].max(f[1]).max(f[2])).max().map_or(1, |v| u64::from(v) + 1);
    // A counting sort of the sides by their lower vertex, or a range of vertices where few have faces.
    let buckets = end.min(3 * faces.len() as u64).max(1);
    let ends = |side: u32| {
        let (face, e) = (faces[side as usize / 3], side as usize % 3);
        let (a, b) = (face[e], face[(e + 1) % 3]);
        (a.min(b), a.max(b))
    };
    let bucket = |side: u32| (u64::from(ends(side).0) * buckets / end) as usize;
    let mut first = vec![0u32; buckets as usize + 1];
    let count = 3 * faces.len() as u32;
    (0..count).for_each(|side| first[bucket(side)] += 1);
    let mut sum = 0;
    for f in &mut first {
        sum += *f;
        *f = sum;
    }
    let mut sides = vec![0u32; count as usize];
    for side in (0..count).rev() {
        let place = &mut first[bucket(side)];
        *place -= 1;
        sides[*place as usize] = side;
    }
    let mut out = vec![[NOTHING; 3]; faces.len()];
    for range in first.windows(2) {
        let group = &mut sides[range[0] as usize..range[1] as usize];
        group.sort_unstable_by_key(|&side| ends(side));
        for same in group.chunk_by(|&a, &b| ends(a) == ends(b)) {
            if let [p, q] = *same {
                let (p, q) = (p as usize, q as usize);
                out[p / 3][p % 3] = (q / 3) as i32;
                out[q / 3][q % 3] = (p / 3) as i32;
            }
        }
    }
    out
}

/// Connected parts of faces that share an edge and for which `joined` holds: a part number a face, and how many parts.
pub fn components(neighbours: &[[i32; 3]], joined: impl Fn(usize, usize) -> bool) -> (Vec<u32>, usize) {
    let mut part = vec![u32::MAX; neighbours.len()];
    let mut count = 0;
    let mut stack = Vec::new();
    for seed in 0..neighbours.len() {
        if part[seed] != u32::MAX {
            continue;
        }
        part[seed] = count;
        stack.push(seed);
        while let Some(f) = stack.pop() {
            for &g in &neighbours[f] {
                if g != NOTHING && part[g as usize] == u32::MAX && joined(f, g as usize) {
                    part[g as usize] = count;
                    stack.push(g as usize);
                }
            }
        }
        count += 1;
    }
    (part, count as usize)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn two_triangles_share_an_edge_and_a_third_stands_alone() {
        let faces = [[0, 1, 2], [2, 1, 3], [4, 5, 6]];
        let n = neighbours(&faces);
        assert_eq!(n, [[-1, 1, -1], [0, -1, -1], [-1, -1, -1]]);
        assert_eq!(components(&n, |_, _| true), (vec![0, 0, 1], 2));
        assert_eq!(components(&n, |_, _| false).1, 3);
        let far = [[0, 1, u32::MAX], [u32::MAX, 1, 3], [7, u32::MAX - 1, 9]];
        assert_eq!(neighbours(&far), [[-1, 1, -1], [0, -1, -1], [-1, -1, -1]]);
    }

    #[test]
    fn a_face_of_a_missing_vertex_is_refused() {
        assert!(Mesh::new(&[[0.0; 3]; 3], &[[0, 1, 3]]).unwrap_err().to_string().starts_with("faces:"));
    }
}
