//! The triangles of a Marching-Cubes cell, derived instead of typed in.
//!
//! ```text
//!   corner c = 4·x + 2·y + z          on every face the inside corners are cut off from each other, by a rule that looks
//!   bit c of the case: inside         at that face alone: both cells of a face agree, so the surface has no crack
//! ```
//!
//! The segments of the six faces join into loops; a loop is cut into triangles so that no diagonal lies in a face of the
//! cell, where the neighbour could repeat it. Lorensen and Cline, SIGGRAPH 1987; the face rule after Lewiner et al., JGT 2003.

use std::sync::LazyLock;

/// The two corners of each edge; edges 0-3 run along x, 4-7 along y, 8-11 along z. The first corner is the lower one.
pub const EDGES: [(usize, usize); 12] =
    [(0, 4), (1, 5), (2, 6), (3, 7), (0, 2), (1, 3), (4, 6), (5, 7), (0, 1), (2, 3), (4, 5), (6, 7)];

/// Corners of each face, counter-clockwise seen from outside the cell.
const FACES: [[usize; 4]; 6] = [[0, 1, 3, 2], [4, 6, 7, 5], [0, 4, 5, 1], [2, 3, 7, 6], [0, 2, 6, 4], [1, 5, 7, 3]];

/// For each of the 256 cases the triangles as triples of edges, counter-clockwise seen from outside the surface.
pub static TRIANGLES: LazyLock<Vec<Vec<[u8; 3]>>> = LazyLock::new(|| (0..256).map(triangles).collect());

fn triangles(case: usize) -> Vec<[u8; 3]> {
    let mut next = [usize::MAX; 12];
    for face in &FACES {
        let inside = |n: usize| case >> face[n % 4] & 1 == 1;
        for start in 0..4 {
            // A run of inside corners begins at `start + 1`: the surface enters the face where the run ends.
            if !inside(start) && inside(start + 1) {
                let mut end = start + 1;
                while inside(end + 1) {
                    end += 1;
                }
                next[edge(face[start], face[(start + 1) % 4])] = edge(face[end % 4], face[(end + 1) % 4]);
            }
        }
    }
    let mut done = [false; 12];
    let mut out = Vec::new();
    for first in 0..12 {
        if next[first] == usize::MAX || done[first] {
            continue;
        }
        let mut ring = Vec::new();
        let mut at = first;
        while !done[at] {
            done[at] = true;
            ring.push(at);
            at = next[at];
        }
        cut(&ring, &mut out);
    }
    out
}

fn edge(a: usize, b: usize) -> usize {
    let wanted = (a.min(b), a.max(b));
    EDGES.iter().position(|&e| e == wanted).unwrap_or(0)
}

/// Cheapest triangulation of a ring, by dynamic programming over its chords.
fn cut(ring: &[usize], out: &mut Vec<[u8; 3]>) {
    let n = ring.len();
    let mut cost = vec![vec![0.0f32; n]; n];
    let mut split = vec![vec![0; n]; n];
    for span in 2..n {
        for i in 0..n - span {
            let j = i + span;
            let (best, k) = (i + 1..j)
                .map(|k| (cost[i][k] + cost[k][j], k))
                .min_by(|a, b| a.0.total_cmp(&b.0))
                .unwrap_or((0.0, i + 1));
            cost[i][j] = best + if span < n - 1 { chord(ring[i], ring[j]) } else { 0.0 };
            split[i][j] = k;
        }
    }
    let mut todo = vec![(0, n - 1)];
    while let Some((i, j)) = todo.pop() {
        if j - i >= 2 {
            let k = split[i][j];
            out.push([ring[i] as u8, ring[k] as u8, ring[j] as u8]);
            todo.extend([(i, k), (k, j)]);
        }
    }
}

/// Squared length between edge midpoints; prohibitive if both edges lie on one face of the cell.
fn chord(a: usize, b: usize) -> f32 {
    let corners = |e: usize| [EDGES[e].0, EDGES[e].1];
    let on = |face: &[usize; 4], e: usize| corners(e).iter().all(|c| face.contains(c));
    if FACES.iter().any(|face| on(face, a) && on(face, b)) {
        return 100.0;
    }
    let middle = |e: usize, bit: usize| corners(e).iter().map(|c| (c >> bit & 1) as f32).sum::<f32>() / 2.0;
    (0..3).map(|bit| (middle(a, bit) - middle(b, bit)).powi(2)).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_case_has_a_border_only_on_faces_and_no_diagonal_in_one() {
        for (case, list) in TRIANGLES.iter().enumerate() {
            let mut directed = std::collections::HashMap::new();
            for t in list {
                for (a, b) in [(t[0], t[1]), (t[1], t[2]), (t[2], t[0])] {
                    *directed.entry((a, b)).or_insert(0) += 1;
                }
            }
            for (&(a, b), &count) in &directed {
                assert_eq!(count, 1, "case {case}: edge used twice in one direction");
                let shared_face = chord(a as usize, b as usize) > 99.0;
                assert_eq!(shared_face, !directed.contains_key(&(b, a)), "case {case}: {a}-{b}");
            }
        }
    }

    #[test]
    fn a_lone_inside_corner_is_enclosed_outward() {
        let t = TRIANGLES[1][0].map(|e| {
            let (a, b) = EDGES[e as usize];
            [4, 2, 1].map(|bit| (f32::from((a & bit != 0) as u8) + f32::from((b & bit != 0) as u8)) / 2.0)
        });
        let minus = |p: [f32; 3], q: [f32; 3]| [p[0] - q[0], p[1] - q[1], p[2] - q[2]];
        let (u, v) = (minus(t[1], t[0]), minus(t[2], t[0]));
        let normal = [u[1] * v[2] - u[2] * v[1], u[2] * v[0] - u[0] * v[2], u[0] * v[1] - u[1] * v[0]];
        assert!(normal.iter().all(|&n| n > 0.0), "{normal:?}");
    }
}
