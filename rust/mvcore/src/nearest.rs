//! The nearest of a set of points to each of another, and its distance, exactly, by a k-d tree.
//!
//! ```text
//!   order:  [ ... left half ... | median | ... right half ... ]      split along the longest side of the box, again and again,
//!                                                                    down to LEAF points
//! ```
//!
//! The tree is the order of the points itself: a range's median splits it. Bentley, CACM 1975.

use crate::error::{Result, require};
use crate::interrupt::Interrupt;
use rayon::prelude::*;

/// Points below which a range is searched one by one.
const LEAF: usize = 12;
/// Points above which the halves of a range are built side by side.
const LARGE: usize = 1 << 14;

/// For each of `points` the distance to the nearest of `others` (not empty), and its number; of several the lowest. Where none lies within
/// `reach` the distance is infinite and the number -1.
pub fn nearest(points: &[[f64; 3]], others: &[[f64; 3]], reach: f64) -> Result<(Vec<f64>, Vec<i64>)> {
    require(!others.is_empty(), "others", "at least one point", "none")?;
    require(others.len() < u32::MAX as usize, "others", "fewer than 2^32 points", others.len())?;
    require(reach > 0.0, "reach", "a positive distance", reach)?;
    let finite = |p: &[[f64; 3]]| p.iter().flatten().all(|v| v.is_finite());
    require(finite(points) && finite(others), "points", "finite coordinates", "NaN or infinity")?;
    let mut tree: Vec<Node> =
        others.iter().enumerate().map(|(n, &at)| Node { at, number: n as u32, axis: 0 }).collect();
    build(&mut tree);
    let interrupt = Interrupt::current();
    let search = |p: &[f64; 3]| {
        interrupt.poll();
        let mut best = (reach * reach, u32::MAX);
        find(&tree, p, &mut best);
        if best.1 == u32::MAX { (f64::INFINITY, -1) } else { (best.0.sqrt(), i64::from(best.1)) }
    };
    Ok(points.par_iter().with_min_len(256).map(search).unzip())
}

/// A point, its number, and the axis along which it splits its range.
#[derive(Clone, Copy)]
struct Node {
    at: [f64; 3],
    number: u32,
    axis: u8,
}

fn build(range: &mut [Node]) {
    if range.len() <= LEAF {
        return;
    }
    let (mut low, mut high) = ([f64::MAX; 3], [f64::MIN; 3]);
    for node in range.iter() {
        for k in 0..3 {
            low[k] = low[k].min(node.at[k]);
            high[k] = high[k].max(node.at[k]);
        }
    }
    let axis = (0..3).max_by(|&a, &b| (high[a] - low[a]).total_cmp(&(high[b] - low[b]))).unwrap_or(0);
    let middle = range.len() / 2;
    // Ties by number: the same tree for any order of work.
    let before = |a: &Node, b: &Node| a.at[axis].total_cmp(&b.at[axis]).then(a.number.cmp(&b.number));
    let (left, median, right) = range.select_nth_unstable_by(middle, before);
    median.axis = axis as u8;
    if left.len() > LARGE {
        rayon::join(|| build(left), || build(right));
    } else {
        build(left);
        build(right);
    }
}

/// Lowers `best`, a squared distance and a number, by the points of a range.
fn find(range: &[Node], p: &[f64; 3], best: &mut (f64, u32)) {
    if range.len() <= LEAF {
        range.iter().for_each(|node| compare(node, p, best));
        return;
    }
    let middle = range.len() / 2;
    let node = &range[middle];
    let away = p[node.axis as usize] - node.at[node.axis as usize];
    let (near, far) =
        if away < 0.0 { (&range[..middle], &range[middle + 1..]) } else { (&range[middle + 1..], &range[..middle]) };
    find(near, p, best);
    // A point as near as the best one may have a lower number.
    if away * away <= best.0 {
        compare(node, p, best);
        find(far, p, best);
    }
}

#[inline(always)]
fn compare(node: &Node, p: &[f64; 3], best: &mut (f64, u32)) {
    let d = (0..3).map(|k| (p[k] - node.at[k]).powi(2)).sum::<f64>();
    if d < best.0 || (d == best.0 && node.number < best.1) {
        *best = (d, node.number);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn equals_brute_force(
            points in prop::collection::vec(prop::array::uniform3(-3.0f64..3.0), 1..40),
            others in prop::collection::vec(prop::array::uniform3(-1.0f64..1.0), 1..200),
            flat in any::<bool>(),
            reach in prop_oneof![Just(f64::INFINITY), 0.1f64..3.0],
        ) {
            let others: Vec<[f64; 3]> = others.into_iter().map(|p| if flat { [p[0], p[1], 0.5] } else { p }).collect();
            let (distances, numbers) = nearest(&points, &others, reach).unwrap();
            for ((p, d), n) in points.iter().zip(distances).zip(numbers) {
                let brute = others.iter().map(|q| (0..3).map(|k| (p[k] - q[k]).powi(2)).sum::<f64>().sqrt()).fold(f64::MAX, f64::min);
                if n < 0 {
                    prop_assert!(d == f64::INFINITY && brute >= reach * (1.0 - 1e-12));
                    continue;
                }
                let own = (0..3).map(|k| (p[k] - others[n as usize][k]).powi(2)).sum::<f64>().sqrt();
                prop_assert!((d - own).abs() < 1e-12);
                prop_assert!((d - brute).abs() < 1e-12);
            }
        }
    }

    #[test]
    fn nothing_to_be_near_to_is_an_error() {
        assert!(nearest(&[[0.0; 3]], &[], 1.0).is_err());
        assert!(nearest(&[], &[[0.0; 3]], 1.0).unwrap().0.is_empty());
        // A thousand equal points: the first.
        assert_eq!(nearest(&[[1.0; 3]], &[[0.5; 3]; 1000], f64::INFINITY).unwrap().1, [0]);
    }
}
