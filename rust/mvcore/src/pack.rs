//! Skyline packing of rectangles.

/// Where each rectangle (width, height) goes in a square-ish area, tallest first, and the area's size. The width is a multiple of 64 and at
/// least `least`.
pub fn pack(sizes: &[(usize, usize)], least: usize) -> (Vec<(usize, usize)>, usize, usize) {
    let mut order: Vec<usize> = (0..sizes.len()).filter(|&c| sizes[c].0 > 0).collect();
    order.sort_by_key(|&c| (std::cmp::Reverse(sizes[c].1), std::cmp::Reverse(sizes[c].0), c));
    let area: usize = sizes.iter().map(|s| s.0 * s.1).sum();
    let widest = sizes.iter().map(|s| s.0).max().unwrap_or(0).max(least);
    let width = widest.max((area as f64).sqrt() as usize + least).next_multiple_of(64);
    let mut places = vec![(0, 0); sizes.len()];
    // The skyline: (x, height) of each step, x ascending.
    let mut line = vec![(0usize, 0usize)];
    for c in order {
        let (w, h) = sizes[c];
        let mut best = (usize::MAX, 0);
        for i in 0..line.len() {
            let x = line[i].0;
            if x + w > width {
                break;
            }
            let top = line[i..].iter().take_while(|s| s.0 < x + w).map(|s| s.1).max().unwrap_or(0);
            if top < best.0 {
                best = (top, i);
            }
        }
        let (top, i) = best;
        let x = line[i].0;
        let end = line[i..].iter().position(|s| s.0 >= x + w).map_or(line.len(), |n| i + n);
        let after = line[end - 1].1;
        let beyond = line.get(end).map_or(width, |s| s.0);
        let mut steps = vec![(x, top + h)];
        if x + w < beyond {
            steps.push((x + w, after));
        }
        line.splice(i..end, steps);
        places[c] = (x, top);
    }
    (places, width, line.iter().map(|s| s.1).max().unwrap_or(0))
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn rectangles_do_not_overlap(sizes in prop::collection::vec((1usize..40, 1usize..30), 1..200)) {
            let (places, width, height) = pack(&sizes, 4);
            let mut taken = vec![false; width * height];
            for (&(x0, y0), &(w, h)) in places.iter().zip(&sizes) {
                for y in y0..y0 + h {
                    for x in x0..x0 + w {
                        prop_assert!(x < width && y < height && !std::mem::replace(&mut taken[y * width + x], true));
                    }
                }
            }
            let used = taken.iter().filter(|&&t| t).count();
            prop_assert!(sizes.len() < 100 || used * 10 > width * height * 5, "{used} of {}", width * height);
        }
    }

    #[test]
    fn nothing_takes_no_rows() {
        assert_eq!(pack(&[], 4), (vec![], 64, 0));
    }
}
