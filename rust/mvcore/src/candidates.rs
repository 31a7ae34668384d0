//! The short list of views of each face: how many views there are does not change its size.
//!
//! ```text
//!   face f │ view    3    0    7   -1 │      a free slot has view -1 and quality 0
//!          │ quality 9.1  4.0  6.2  0 │      a view that comes takes the place of the worst, if it is better
//!          │ colour  rgb  rgb  rgb  0 │
//! ```

use crate::error::{Result, require};
use crate::mesh::NOTHING;
use rayon::prelude::*;

/// `slots` views a face, in no order.
#[derive(Debug)]
pub struct Candidates<'a> {
    /// Views that a face can have.
    pub slots: usize,
    /// Number of the view, [`NOTHING`] where the slot is free.
    pub views: &'a mut [i16],
    /// More than 0; 0 where the slot is free or its view rejected.
    pub qualities: &'a mut [f32],
    /// The view's mean colour of the face.
    pub colours: &'a mut [[u8; 3]],
}

impl<'a> Candidates<'a> {
    /// Lists of `slots` views each; the three slices are of one length.
    pub fn new(
        slots: usize,
        views: &'a mut [i16],
        qualities: &'a mut [f32],
        colours: &'a mut [[u8; 3]],
    ) -> Result<Self> {
        let n = views.len();
        require(slots > 0 && n.is_multiple_of(slots), "views", "one slot a face or more", slots)?;
        require(qualities.len() == n, "qualities", format!("{n} values"), qualities.len())?;
        require(colours.len() == n, "colours", format!("{n} colours"), colours.len())?;
        Ok(Self { slots, views, qualities, colours })
    }

    /// How many faces have a list.
    pub fn len(&self) -> usize {
        self.views.len() / self.slots
    }

    /// Whether there are no faces.
    pub fn is_empty(&self) -> bool {
        self.views.is_empty()
    }

    /// The slots of a face.
    #[inline(always)]
    pub fn of(&self, face: usize) -> std::ops::Range<usize> {
        face * self.slots..(face + 1) * self.slots
    }

    /// Quality of a view for a face, 0 where it is not in the list.
    #[inline(always)]
    pub fn quality(&self, face: usize, view: i32) -> f32 {
        let slot = self.of(face).find(|&s| i32::from(self.views[s]) == view);
        slot.map_or(0.0, |s| self.qualities[s])
    }

    /// Fails unless all views are below `count` and only free slots without one.
    pub fn check(&self, count: usize) -> Result<()> {
        let known =
            |(&v, &q): (&i16, &f32)| i64::from(v) < count as i64 && (v >= 0 || (i32::from(v) == NOTHING && q == 0.0));
        let all = self.views.par_iter().zip(self.qualities.par_iter()).all(known);
        require(all, "views", format!("numbers below {count}, {NOTHING} where the quality is 0"), "another")
    }

    /// Lists a view with the faces that it is better for than the worst in their lists; of equals the one that came first stays.
    pub fn keep_best(&mut self, view: i16, quality: &[f32], colour: &[[u8; 3]]) -> Result<()> {
        let (n, slots) = (self.len(), self.slots);
        require(view >= 0, "view", "0 or more", view)?;
        require(quality.len() == n, "quality", format!("{n} values"), quality.len())?;
        require(colour.len() == n, "colour", format!("{n} colours"), colour.len())?;
        let lists = self.views.par_chunks_exact_mut(slots).zip(self.qualities.par_chunks_exact_mut(slots));
        lists.zip(self.colours.par_chunks_exact_mut(slots)).zip(quality.par_iter().zip(colour)).for_each(
            |(((views, qualities), colours), (&quality, &colour))| {
                if quality <= 0.0 {
                    return;
                }
                let worst = (1..slots).fold(0, |w, s| if qualities[s] < qualities[w] { s } else { w });
                if quality > qualities[worst] {
                    (views[worst], qualities[worst], colours[worst]) = (view, quality, colour);
                }
            },
        );
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    proptest! {
        #[test]
        fn a_list_holds_the_best_views(ratings in prop::collection::vec(prop::collection::vec(0u8..20, 3), 1..9)) {
            let (mut views, mut qualities, mut colours) = ([-1i16; 6], [0f32; 6], [[0u8; 3]; 6]);
            let mut lists = Candidates::new(2, &mut views, &mut qualities, &mut colours).unwrap();
            for (v, rating) in ratings.iter().enumerate() {
                let quality: Vec<f32> = rating.iter().map(|&q| f32::from(q)).collect();
                lists.keep_best(v as i16, &quality, &[[v as u8; 3]; 3]).unwrap();
            }
            for f in 0..3 {
                let mut all: Vec<u8> = ratings.iter().map(|r| r[f]).collect();
                all.sort_unstable_by(|a, b| b.cmp(a));
                all.resize(2, 0);
                let mut kept: Vec<f32> = lists.qualities[lists.of(f)].to_vec();
                kept.sort_unstable_by(|a, b| b.total_cmp(a));
                prop_assert_eq!(&kept, &all[..2].iter().map(|&q| f32::from(q)).collect::<Vec<_>>());
                for s in lists.of(f).filter(|&s| lists.qualities[s] > 0.0) {
                    let v = lists.views[s] as usize;
                    prop_assert_eq!(f32::from(ratings[v][f]), lists.qualities[s]);
                    prop_assert_eq!(lists.colours[s], [v as u8; 3]);
                    prop_assert_eq!(lists.quality(f, v as i32), lists.qualities[s]);
                }
            }
        }
    }

    #[test]
    fn lists_of_another_length_are_refused() {
        let (mut views, mut qualities, mut colours) = ([-1i16; 4], [0f32; 4], [[0u8; 3]; 4]);
        assert!(Candidates::new(3, &mut views, &mut qualities, &mut colours).is_err());
        let mut lists = Candidates::new(2, &mut views, &mut qualities, &mut colours).unwrap();
        assert!(lists.keep_best(0, &[1.0], &[[0; 3]; 2]).unwrap_err().to_string().starts_with("quality:"));
        assert!(lists.keep_best(-1, &[1.0; 2], &[[0; 3]; 2]).unwrap_err().to_string().starts_with("view:"));
        lists.keep_best(5, &[1.0; 2], &[[0; 3]; 2]).unwrap();
        assert!(lists.check(5).is_err() && lists.check(6).is_ok());
        lists.views[0] = -1;
        assert!(lists.check(6).is_err());
    }
}
