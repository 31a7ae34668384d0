//! What the tests of several kernels share.

/// A camera on the circle of radius 4 around the origin.
pub fn camera(angle: f64, w: usize, h: usize) -> [f64; 12] {
    let (s, c) = angle.sin_cos();
    // Axes: right (-s, c, 0), down (0, 0, -1), forward (-c, -s, 0); centre (4 c, 4 s, 0).
    let (f, cx, cy) = (60.0, (w - 1) as f64 / 2.0, (h - 1) as f64 / 2.0);
    let forward = [-c, -s, 0.0, 4.0];
    let (right, down) = ([-s, c, 0.0, 0.0], [0.0, 0.0, -1.0, 0.0]);
    std::array::from_fn(|n| match n / 4 {
        0 => f * right[n % 4] + cx * forward[n % 4],
        1 => f * down[n % 4] + cy * forward[n % 4],
        _ => forward[n % 4],
    })
}
