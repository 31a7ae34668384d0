//! The ratio of the colours of two views that see the same faces, for each pair of views that do.
//!
//! ```text
//!   a sample of the faces ──► each pair of views in a face's list: ln colour of one - ln colour of the other ──► median a pair
//! ```
//!
//! The sample grows with the views, not with the faces, so cost is linear in views.

use crate::candidates::Candidates;
use crate::error::{Result, require};
use rayon::prelude::*;

/// How the colours of two views differ.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Comparison {
    /// The two views, the lower number first.
    pub pair: [i32; 2],
    /// Faces that were compared.
    pub count: u32,
    /// Median over these faces of ln(colour in the first) - ln(colour in the second), a channel.
    pub ratio: [f32; 3],
}

/// Grey levels beyond which a colour is too dark or saturated to be compared.
const USABLE: std::ops::Range<u8> = 13..245;

/// Compares the views pair by pair over about `sample` faces a view, pairs in ascending order.
pub fn compare_views(lists: &Candidates, views: usize, sample: usize) -> Result<Vec<Comparison>> {
    require(sample > 0, "sample", "1 or more", sample)?;
    lists.check(views)?;
    let logs: [f32; 256] = std::array::from_fn(|c| (c.max(1) as f32).ln());
    let step = (lists.len() / sample.saturating_mul(views).max(1)).max(1);
    let mut samples: Vec<(u32, [f32; 3])> = Vec::new();
    for face in (0..lists.len()).step_by(step) {
        let usable = |&s: &usize| lists.qualities[s] > 0.0 && lists.colours[s].iter().all(|c| USABLE.contains(c));
        let slots: Vec<usize> = lists.of(face).filter(usable).collect();
        for (n, &s) in slots.iter().enumerate() {
            for &t in &slots[n + 1..] {
                let (a, b) = if lists.views[s] < lists.views[t] { (s, t) } else { (t, s) };
                let log = |s: usize, k: usize| logs[usize::from(lists.colours[s][k])];
                let pair = ((lists.views[a] as u32) << 16) | lists.views[b] as u32;
                samples.push((pair, std::array::from_fn(|k| log(a, k) - log(b, k))));
            }
        }
    }
    samples.par_sort_unstable_by_key(|s| s.0);
    let groups: Vec<&[(u32, [f32; 3])]> = samples.chunk_by(|a, b| a.0 == b.0).collect();
    let compare = |group: &&[(u32, [f32; 3])]| {
        let pair = [group[0].0 >> 16, group[0].0 & 0xffff].map(|v| v as i32);
        let ratio = std::array::from_fn(|k| median(group.iter().map(|s| s.1[k]).collect()));
        Comparison { pair, count: group.len() as u32, ratio }
    };
    Ok(groups.par_iter().map(compare).collect())
}

/// Median of at least one value, the middle of the two in the middle of an even number.
fn median(mut values: Vec<f32>) -> f32 {
    let n = values.len();
    let (below, &mut high, _) = values.select_nth_unstable_by(n / 2, f32::total_cmp);
    if n % 2 == 1 {
        return high;
    }
    let low = below.iter().copied().fold(f32::MIN, f32::max);
    0.5 * (low + high)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_view_twice_as_bright_shows_in_its_ratios() {
        let n = 300;
        let mut views: Vec<i16> = (0..n).flat_map(|_| [4, 1, -1]).collect();
        let mut qualities: Vec<f32> = (0..n).flat_map(|_| [1.0, 1.0, 0.0]).collect();
        let base = |f: usize| 40 + (f % 70) as u8;
        let mut colours: Vec<[u8; 3]> = (0..n).flat_map(|f| [[2 * base(f); 3], [base(f); 3], [0; 3]]).collect();
        // An occluder in a third of the faces does not move the median.
        (0..n / 3).for_each(|f| colours[3 * 3 * f] = [200, 14, 90]);
        let lists = Candidates::new(3, &mut views, &mut qualities, &mut colours).unwrap();
        let found = compare_views(&lists, 5, 1000).unwrap();
        assert_eq!((found.len(), found[0].pair, found[0].count), (1, [1, 4], 300));
        assert!(found[0].ratio.iter().all(|r| (r + 2f32.ln()).abs() < 1e-5), "{found:?}");
        // A sample of a quarter of the faces.
        assert_eq!(compare_views(&lists, 5, 15).unwrap()[0].count, 75);
        assert!(compare_views(&lists, 4, 15).is_err());
    }

    #[test]
    fn dark_and_saturated_faces_do_not_count() {
        let (mut views, mut qualities) = ([0i16, 1], [1f32; 2]);
        for (grey, counted) in [(12, false), (13, true), (244, true), (245, false)] {
            let mut colours = [[100; 3], [100, grey, 100]];
            let lists = Candidates::new(2, &mut views, &mut qualities, &mut colours).unwrap();
            assert_eq!(!compare_views(&lists, 2, 10).unwrap().is_empty(), counted);
        }
    }

    #[test]
    fn the_median_of_an_even_number_is_in_the_middle() {
        assert_eq!(median(vec![4.0, 1.0, 3.0, 2.0]), 2.5);
        assert_eq!(median(vec![5.0, 1.0, 3.0]), 3.0);
    }
}
