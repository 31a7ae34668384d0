//! Throughput of each kernel on inputs like those of a real job: `cargo bench`, or `cargo bench -- aggregate`.
//!
//! Images are band-limited noise shifted by a slanted plane, depth maps those of a sphere, fields those of a gyroid: textured,
//! noisy, never constant.
#![allow(missing_docs, clippy::unwrap_used)]

use criterion::{BatchSize, BenchmarkId, Criterion, Throughput, criterion_group, criterion_main};
use mvcore::aggregate::{Penalties, aggregate};
use mvcore::atlas::Atlas;
use mvcore::candidates::Candidates;
use mvcore::carve::{CarveParams, Silhouette, carve};
use mvcore::compare_views::compare_views;
use mvcore::consistency::{ConsistencyParams, OtherView, consistency};
use mvcore::expect::expect;
use mvcore::fuse::{FusionParams, FusionView, fuse};
use mvcore::grid::Grid;
use mvcore::holes::close_holes;
use mvcore::isosurface::{isosurface_dense, isosurface_sparse};
use mvcore::match_epipolar::{DESCRIPTOR, Features, match_epipolar};
use mvcore::median::{MedianParams, weighted_median};
use mvcore::mesh::Mesh;
use mvcore::nearest::nearest;
use mvcore::nurbs::{self, Knots, Net};
use mvcore::photo_carve::{Photo as Coloured, PhotoParams, photo_carve};
use mvcore::raster::{Epipolar, Raster};
use mvcore::rasterize::rasterize;
use mvcore::rate_faces::{Photo, rate_faces};
use mvcore::select_views::{SelectParams, select_views};
use mvcore::shade::{Shots, Surface};
use mvcore::slanted::{Hypothesis, RefineParams, refine};
use mvcore::sweep::sweep;
use std::hint::black_box;

const PAIR: Epipolar = Epipolar { matrix: [1., 0., 0., 0., 1., 0., 0., 0., 1.], offset: [-1., 0., 0.] };

struct Random(u64);

impl Random {
    fn next(&mut self) -> f64 {
        self.0 ^= self.0 << 13;
        self.0 ^= self.0 >> 7;
        self.0 ^= self.0 << 17;
        (self.0 >> 11) as f64 / (1u64 << 53) as f64
    }
}

fn shade(x: f32, y: f32) -> u8 {
    let v = (x * 0.71).sin() + (y * 0.53 + x * 0.31).sin() + (x * 0.23 - y * 0.87).sin() + (x * 1.9 + y * 1.3).sin();
    (127.0 + 30.0 * v) as u8
}

fn disparity(x: usize) -> f32 {
    8.0 + 0.03 * x as f32
}

fn pair(w: usize, h: usize) -> (Vec<u8>, Vec<u8>) {
    let left = (0..w * h).map(|i| shade((i % w) as f32 - disparity(i % w), (i / w) as f32)).collect();
    let right = (0..w * h).map(|i| shade((i % w) as f32, (i / w) as f32)).collect();
    (left, right)
}

fn stereo(c: &mut Criterion) {
    let (w, h) = (384, 288);
    let (left, right) = pair(w, h);
    let (l, r) = (Raster::new(&left, w, h, "l").unwrap(), Raster::new(&right, w, h, "r").unwrap());
    let planes: Vec<f32> = (0..128).map(|d| d as f32 * 0.25).collect();
    let sources = [(r, PAIR); 6];
    let mut group = c.benchmark_group("depth");
    group.sample_size(10);
    group.throughput(Throughput::Elements((w * h * 128 * 6) as u64));
    group.bench_function("sweep 384x288x128, 6 sources", |b| b.iter(|| sweep(l, &sources, &planes, 0).unwrap()));
    let init: Vec<_> = (0..w * h).map(|i| Hypothesis { w: disparity(i % w) + 0.4, ..Default::default() }).collect();
    let params = RefineParams {
        iterations: 1,
        range: (0.5, 40.0),
        step: 1.0,
        max_slope: 0.5,
        prior_weight: 0.1,
        prior_reach: 4.0,
        geometry_weight: 0.0,
        adjacent: false,
    };
    let prior = vec![0.0; w * h];
    group.throughput(Throughput::Elements((w * h) as u64));
    group.bench_function("refine 384x288, 6 sources, 1 round", |b| {
        b.iter(|| refine(l, &sources, &[], &init, &prior, &params).unwrap());
    });
    let (w, h, d) = (1280, 960, 128);
    let mut random = Random(7);
    let guide = pair(w, h).0;
    let costs: Vec<u8> = (0..w * h * d)
        .map(|i| {
            let miss = ((i % d) as f32 - disparity(i / d % w)).abs();
            (miss * 6.0).min(40.0) as u8 + (random.next() * 20.0) as u8
        })
        .collect();
    let guide = Raster::new(&guide, w, h, "guide").unwrap();
    let penalties = Penalties { p1: 6, p2: 60, p2_falloff: 12 };
    group.throughput(Throughput::Bytes((w * h * d) as u64));
    group.bench_function("aggregate 1280x960x128", |b| b.iter(|| aggregate(&costs, d, guide, penalties).unwrap()));
    let mut volume = costs.clone();
    let (expected, sure): (Vec<f32>, Vec<f32>) = (0..w * h).map(|i| (disparity(i % w), random.next() as f32)).unzip();
    group.bench_function("expect 1280x960x128", |b| b.iter(|| expect(&mut volume, d, &expected, &sure, 20.0, 4.0)));
    // A slope with a step every 160 columns, a pixel off the picture's edges, and one pixel in ten wrong.
    let rgb: Vec<u8> =
        (0..w * h * 3).map(|i| guide.data[i / 3] / 4 + if i / 3 % w / 160 % 2 == 0 { 20 } else { 160 }).collect();
    let found: Vec<f32> = (0..w * h)
        .map(|i| {
            let step = if (i % w + 1) / 160 % 2 == 0 { 0.0 } else { 12.0 };
            disparity(i % w) + step + if random.next() < 0.1 { 9.0 * random.next() as f32 } else { 0.0 }
        })
        .collect();
    let doubtful = vec![0; w * h];
    let rasters = || {
        let (found, doubtful) =
            (Raster::new(&found, w, h, "found").unwrap(), Raster::new(&doubtful, w, h, "d").unwrap());
        (found, Raster::new(&rgb, 3 * w, h, "rgb").unwrap(), doubtful)
    };
    let params = MedianParams { radius: 10, step: 2, colour: 10.0, distance: 6.0, slack: 1.0 };
    group.throughput(Throughput::Elements((w * h) as u64));
    group.bench_function("weighted median 1280x960, 121 samples", |b| {
        b.iter(|| {
            let (found, rgb, doubtful) = rasters();
            weighted_median(found, rgb, doubtful, &params).unwrap()
        });
    });
    group.finish();
}

/// Cameras on a ring around the origin, looking at it: P, centre, rotation rows.
fn ring(n: usize, k: usize, w: usize, h: usize, focal: f64) -> ([f64; 12], [f64; 3]) {
    let a = std::f64::consts::TAU * k as f64 / n as f64;
    let (s, c) = a.sin_cos();
    let r = [[-s, c, 0.0], [0.0, 0.0, -1.0], [-c, -s, 0.0]];
    let t = [0.0, 0.0, 3.0];
    let (cx, cy) = ((w - 1) as f64 / 2.0, (h - 1) as f64 / 2.0);
    let column = |j: usize| {
        let v = |row: usize| if j < 3 { r[row][j] } else { t[row] };
        [focal * v(0) + cx * v(2), focal * v(1) + cy * v(2), v(2)]
    };
    (std::array::from_fn(|i| column(i % 4)[i / 4]), [3.0 * c, 3.0 * s, 0.0])
}

fn sphere_depth(w: usize, h: usize, focal: f64, radius: f64) -> Vec<f32> {
    let (cx, cy) = ((w - 1) as f64 / 2.0, (h - 1) as f64 / 2.0);
    (0..w * h)
        .map(|i| {
            let d = [((i % w) as f64 - cx) / focal, ((i / w) as f64 - cy) / focal, 1.0];
            let (a, b) = (d.iter().map(|v| v * v).sum::<f64>(), 3.0);
            let root = b * b - a * (9.0 - radius * radius);
            if root > 0.0 { ((b - root.sqrt()) / a) as f32 } else { 0.0 }
        })
        .collect()
}

const FUSION: FusionParams = FusionParams {
    truncation: 0.03,
    free_weight: 0.3,
    min_weight: 0.05,
    solid_weight: 0.5,
    smoothing: 0.0,
    measured_smoothing: 0.0,
    hull_tolerance: 0.05,
    complete: false,
    hollow: true,
    max_memory: 4 << 30,
};

fn volumes(c: &mut Criterion) {
    let (w, h, focal) = (640, 480, 600.0);
    let depth = sphere_depth(w, h, focal, 1.0);
    let weight = vec![1.0f32; w * h];
    let raster = |d| Raster::new(d, w, h, "depth").unwrap();
    let view = |k| FusionView {
        depth: raster(&depth).into(),
        weight: raster(&weight).into(),
        silhouette: None,
        window: [0.0, 0.0, (w - 1) as f64, (h - 1) as f64],
        projection: ring(24, k, w, h, focal).0,
        focal,
    };
    let views: Vec<_> = (0..24).map(view).collect();
    let grid = Grid::new([-1.1; 3], 2.2 / 255.0, [256; 3]).unwrap();
    let mut group = c.benchmark_group("volume");
    group.sample_size(10);
    group.throughput(Throughput::Elements((24 * w * h) as u64));
    let mask: Vec<u8> = depth.iter().map(|&d| u8::from(d > 0.0)).collect();
    let silhouette =
        |k| Silhouette { mask: Raster::new(&mask, w, h, "mask").unwrap(), projection: ring(24, k, w, h, focal).0 };
    let silhouettes: Vec<_> = (0..24).map(silhouette).collect();
    let vote = CarveParams { tolerance: 0.05, least_views: 2 };
    group.bench_function("carve 24 silhouettes 640x480 into 256^3", |b| {
        b.iter(|| carve(grid, &silhouettes, &vote).unwrap())
    });
    let none = vec![0.0f32; w * h];
    // The sphere's silhouette is a circle of focal / sqrt(8) pixels.
    let border = focal / 8f64.sqrt();
    let away = |n: usize| (((n % w) as f64 - 319.5).hypot((n / w) as f64 - 239.5) - border) as f32;
    let soft: Vec<f32> = (0..w * h).map(away).collect();
    let hulls: Vec<_> = views
        .iter()
        .map(|v| FusionView { depth: raster(&none).into(), silhouette: Some(raster(&soft).into()), ..*v })
        .collect();
    group.bench_function("hull field of 24 soft silhouettes in 256^3", |b| {
        b.iter(|| fuse(grid, &hulls, &FUSION).unwrap());
    });
    // The same stripes in every view: they contradict each other all over the ball.
    let coarse = Grid::new([-1.1; 3], 2.2 / 127.0, [128; 3]).unwrap();
    let paint = |n: usize| {
        let stripe = (depth[n] > 0.0) as usize * (1 + (n / w / 24 + n % w / 32) % 3);
        [20u8, 90, 160, 230][stripe]
    };
    let colours: Vec<u8> = (0..w * h * 3).map(|n| paint(n / 3)).collect();
    let photos: Vec<_> = (0..24)
        .map(|k| {
            let (projection, center) = ring(24, k, w, h, focal);
            Coloured { low: &colours, high: &colours, width: w, height: h, projection, center }
        })
        .collect();
    let full = carve(coarse, &silhouettes, &vote).unwrap();
    let judge = PhotoParams { threshold: 40, least_views: 3, rounds: 2 };
    group.bench_function("photo carve 128^3, 24 views, two rounds of six sweeps", |b| {
        b.iter_batched_ref(
            || full.clone(),
            |voxels| photo_carve(coarse, voxels, &photos, &judge).unwrap(),
            BatchSize::LargeInput,
        );
    });
    group.bench_function("fuse 24 maps 640x480 into 256^3", |b| b.iter(|| fuse(grid, &views, &FUSION).unwrap()));
    let smooth = FusionParams { smoothing: 0.7, ..FUSION };
    group.bench_function("the same, smoothed", |b| b.iter(|| fuse(grid, &views, &smooth).unwrap()));
    let masked: Vec<_> = views.iter().map(|v| FusionView { silhouette: Some(raster(&soft).into()), ..*v }).collect();
    let wide = FusionParams { smoothing: 2.0, measured_smoothing: 0.7, ..FUSION };
    group.bench_function("the same cut by silhouettes, smoothed where it was not measured", |b| {
        b.iter(|| fuse(grid, &masked, &wide).unwrap());
    });
    let volume = fuse(grid, &views, &FUSION).unwrap();
    group.throughput(Throughput::Elements(volume.values.len() as u64));
    group.bench_function("isosurface of that, sparse", |b| {
        b.iter(|| isosurface_sparse(&volume.map, &volume.values).unwrap());
    });
    for n in [128usize, 256, 512] {
        let field: Vec<f32> = (0..n * n * n)
            .map(|p| {
                let x = [p / (n * n), p / n % n, p % n].map(|v| (v as f32 + 0.5) / n as f32 - 0.5);
                (x[0] * x[0] + x[1] * x[1] + x[2] * x[2]).sqrt() - 0.4
            })
            .collect();
        group.throughput(Throughput::Bytes((4 * n * n * n) as u64));
        group.bench_with_input(BenchmarkId::new("isosurface of a sphere, dense", n), &n, |b, _| {
            b.iter(|| isosurface_dense(&field, [n; 3]).unwrap());
        });
    }
    let back = |s: f32| Epipolar { offset: [-s, 0., 0.], ..PAIR };
    let others: Vec<_> = [0.1f32, -0.1, 0.2, -0.2]
        .iter()
        .map(|&s| OtherView { depth: raster(&depth), there: back(s), back: back(-s) })
        .collect();
    let params = ConsistencyParams { min_views: 1, pixel_unit: 0.5, depth_unit: 1.0 / 600.0 };
    group.throughput(Throughput::Elements((w * h) as u64));
    group.bench_function("consistency 640x480, 4 views", |b| {
        b.iter(|| consistency(raster(&depth), &others, &params).unwrap());
    });
    group.finish();
}

fn meshes(c: &mut Criterion) {
    let n = 160;
    let field: Vec<f32> = (0..n * n * n)
        .map(|p: usize| {
            let x = [p / (n * n), p / n % n, p % n].map(|v| (v as f32 + 0.5) / n as f32 - 0.5);
            (x[0] * x[0] + x[1] * x[1] + x[2] * x[2]).sqrt() - 0.4 + 0.01 * (60.0 * x[0]).sin() * (60.0 * x[2]).sin()
        })
        .collect();
    let surface = isosurface_dense(&field, [n; 3]).unwrap();
    let vertices: Vec<[f64; 3]> =
        surface.vertices.iter().map(|v| v.map(|x| (f64::from(x) / n as f64 - 0.5) * 2.4)).collect();
    let mesh = Mesh::new(&vertices, &surface.faces).unwrap();
    let (w, h, focal) = (1024, 768, 900.0);
    let rgb: Vec<u8> = (0..w * h * 3).map(|i| shade((i / 3 % w) as f32, (i / 3 / w) as f32)).collect();
    let detail: Vec<f32> = (0..w * h).map(|i| f32::from(shade((i % w) as f32, (i / w) as f32)) / 8.0).collect();
    let image = Raster::new(&rgb, 3 * w, h, "rgb").unwrap();
    let mut group = c.benchmark_group("texture");
    group.sample_size(10);
    group.throughput(Throughput::Elements(surface.faces.len() as u64));
    let (p, center) = ring(8, 0, w, h, focal);
    group.bench_function("rasterize", |b| b.iter(|| rasterize(mesh, &p, w, h).unwrap()));
    let uv: Vec<[f32; 2]> = vertices.iter().map(|v| [v[0] as f32, v[1] as f32]).collect();
    let normals: Vec<[f32; 3]> = vertices.iter().map(|v| v.map(|x| (x / 0.96) as f32)).collect();
    let materials = vec![0; surface.faces.len()];
    // Two textures: the material's, and the surroundings that it mirrors.
    let tiles: Vec<u8> = (0..2 * 256 * 256 * 3).map(|i| shade((i / 3 % 256) as f32, (i / 768) as f32)).collect();
    let covering = Surface {
        uv: &uv,
        normals: &normals,
        materials: &materials,
        textures: &tiles,
        size: 256,
        gloss: &[[0.4, 0.6, 0.3, 20.0, 0.1]],
    };
    let shots = Shots { projections: &[p], lamp: [0.0, 0.0, 4.0], width: 256, height: 192, samples: 2 };
    group.bench_function("shade 256x192, 4 samples a pixel", |b| {
        b.iter(|| mvcore::shade::shade(mesh, covering, &shots).unwrap());
    });
    let (depth, _) = rasterize(mesh, &p, w, h).unwrap();
    let photo = Photo {
        rgb: image,
        detail: Raster::new(&detail, w, h, "detail").unwrap(),
        depth: Raster::new(&depth, w, h, "depth").unwrap(),
        projection: p,
        center,
    };
    group.bench_function("rate_faces", |b| b.iter(|| rate_faces(mesh, &photo, 0.02).unwrap()));
    let n = 8 * surface.faces.len();
    let (mut views, mut qualities, mut colours) = (vec![-1i16; n], vec![0f32; n], vec![[0u8; 3]; n]);
    let mut lists = Candidates::new(8, &mut views, &mut qualities, &mut colours).unwrap();
    for k in 0..8 {
        let (p, center) = ring(8, k, w, h, focal);
        let (depth, _) = rasterize(mesh, &p, w, h).unwrap();
        let depth = Raster::new(&depth, w, h, "depth").unwrap();
        let rated = rate_faces(mesh, &Photo { depth, projection: p, center, ..photo }, 0.02).unwrap();
        lists.keep_best(k as i16, &rated.quality, &rated.colour).unwrap();
    }
    group.bench_function("compare_views, 8 views", |b| b.iter(|| compare_views(&lists, 8, 2000).unwrap()));
    let params = SelectParams { seam: 0.2, unit: 2.4 / n as f64, outlier: 60.0, least_patch: 12.0 };
    let gains = [[1.0; 3]; 8];
    group.bench_function("select_views, 8 views", |b| {
        b.iter(|| select_views(mesh, &mut lists, &gains, &params).unwrap());
    });
    let labels = select_views(mesh, &mut lists, &gains, &params).unwrap();
    let matrices: Vec<_> = (0..8).map(|k| ring(8, k, w, h, focal).0).collect();
    group.bench_function("atlas, 8 views", |b| {
        b.iter(|| {
            let mut atlas = Atlas::plan(mesh, &labels, &matrices).unwrap();
            (0..8).for_each(|k| atlas.add_view(k, &image).unwrap());
            atlas.finish(&gains).unwrap()
        });
    });
    // Every thirtieth face is missing: some twenty thousand small holes.
    let kept: Vec<[u32; 3]> = surface.faces.iter().enumerate().filter(|(n, _)| n % 30 > 0).map(|(_, &f)| f).collect();
    let porous = Mesh::new(&vertices, &kept).unwrap();
    group.bench_function("close_holes", |b| b.iter(|| close_holes(porous, 120).unwrap()));
    group.throughput(Throughput::Elements(vertices.len() as u64));
    let shifted: Vec<[f64; 3]> = vertices.iter().map(|v| v.map(|x| x * 1.01)).collect();
    group.bench_function("nearest", |b| b.iter(|| nearest(&shifted, &vertices, f64::INFINITY).unwrap()));
    group.finish();
}

fn features(c: &mut Criterion) {
    let mut random = Random(11);
    let n = 4000;
    let positions: Vec<[f32; 2]> =
        (0..n).map(|_| [(random.next() * 1024.0) as f32, (random.next() * 768.0) as f32]).collect();
    let descriptors: Vec<[u8; DESCRIPTOR]> =
        (0..n).map(|_| std::array::from_fn(|_| (random.next().powi(3) * 160.0) as u8)).collect();
    let f = Features { positions: &positions, descriptors: &descriptors };
    let rectified = [0., 0., 0., 0., 0., -1., 0., 1., 0.];
    let mut group = c.benchmark_group("sparse");
    group.throughput(Throughput::Elements((n * n) as u64));
    for (name, band) in [("guided, 2 px", 2.0), ("unguided", f32::INFINITY)] {
        group.bench_function(BenchmarkId::new("match_epipolar 4000 x 4000", name), |b| {
            b.iter(|| black_box(match_epipolar(f, f, &rectified, band, 0.8).unwrap()));
        });
    }
    group.finish();
}

/// A bicubic 50 x 50 net; a million scattered points with 6 derivatives write 144 MB, the floor.
fn splines(c: &mut Criterion) {
    let mut random = Random(7);
    let knots: Vec<f64> = (0..54).map(|i| (f64::from(i) - 3.0).clamp(0.0, 47.0) / 47.0).collect();
    let axis = Knots::new("knots", &knots, 50).unwrap();
    let control: Vec<f64> = (0..7500).map(|_| random.next()).collect();
    let net = Net::new("control_points", &control, 50, 50, 3, false).unwrap();
    let (u, v): (Vec<f64>, Vec<f64>) = (0..1_000_000).map(|_| (random.next(), random.next())).unzip();
    let g: Vec<f64> = (0..3_000_000).map(|_| random.next()).collect();
    let line: Vec<f64> = (0..1000).map(|i| f64::from(i) / 999.0).collect();
    let wanted = nurbs::triangle(2).unwrap();
    let mut group = c.benchmark_group("nurbs, a million points");
    group.sample_size(10).throughput(Throughput::Elements(1_000_000));
    group.bench_function("scattered, second derivatives", |b| {
        b.iter(|| nurbs::surface_points(&net, [&axis, &axis], &u, &v, &wanted, 9).unwrap());
    });
    group.bench_function("grid", |b| b.iter(|| nurbs::surface_grid(&net, [&axis, &axis], &line, &line, 0).unwrap()));
    group.bench_function("gradient to control points", |b| {
        b.iter(|| nurbs::control_gradient([&axis, &axis], &u, &v, &g, 3, [0, 0]).unwrap());
    });
    group.finish();
}

criterion_group!(benches, features, stereo, volumes, meshes, splines);
criterion_main!(benches);
