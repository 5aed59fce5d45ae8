//! Predicts coordinates from other coordinates.
//!
//! - A depth camera computes x = (u - cx)·z/f: within a column of pixels x/z is constant. Likewise y/z in a row.
//! - A spinning laser computes z = r·sin ω and √(x² + y²) = r·cos ω: for one laser their quotient is constant, and from
//!   shot to shot y/x hardly changes.
//! - Otherwise the last point of the same laser is nearer than the last point.
//!
//! The quotient is learned from earlier points. Everything is IEEE arithmetic (products, quotients, square roots), so
//! both sides learn exactly the same, whatever their processors.

use super::ReferenceColumns;
use crate::Error;
use crate::column::{Shape, from_ordered_bits, to_ordered_bits};
use crate::predict::{unzigzag, zigzag};

/// Denominator of the quotient.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
enum Reference {
    /// None: the last value is the prediction.
    Last,
    /// The first coded coordinate.
    First,
    /// The second coded coordinate.
    Second,
    /// √(first² + second²)
    Both,
}

/// Number of lasers that are told apart; more than any scanner has share quotients.
const RINGS: usize = 1024;

/// The points that share a quotient.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
enum Sharing {
    /// The whole cloud: the last point counts.
    All,
    /// A column of the picture.
    Column,
    /// A row of the picture.
    Row,
    /// One laser.
    Ring,
}

/// A way to predict a coordinate.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(super) struct CoordinatePredictor {
    reference: Reference,
    sharing: Sharing,
}

const REFERENCES: [Reference; 4] = [Reference::Last, Reference::First, Reference::Second, Reference::Both];
const SHARINGS: [Sharing; 4] = [Sharing::All, Sharing::Column, Sharing::Row, Sharing::Ring];

impl CoordinatePredictor {
    fn all() -> impl Iterator<Item = Self> {
        REFERENCES
            .into_iter()
            .flat_map(|reference| SHARINGS.into_iter().map(move |sharing| Self { reference, sharing }))
    }

    /// Returns true if the predictor can be useful with the known columns.
    fn is_applicable(self, known: &ReferenceColumns, shape: Shape) -> bool {
        let needed = match self.reference {
            Reference::Last => 0,
            Reference::First => 1,
            Reference::Second | Reference::Both => 2,
        };
        let picture = matches!(shape, Shape::Picture { .. });
        known.coordinates.len() >= needed
            && match self.sharing {
                Sharing::All => self.reference != Reference::Last,
                Sharing::Column | Sharing::Row => picture && self.reference != Reference::Last,
                Sharing::Ring => known.ring.is_some(),
            }
    }

    pub(super) fn name(self) -> u8 {
        (self.reference as u8) << 4 | self.sharing as u8
    }

    pub(super) fn from_name(name: u8, known: &ReferenceColumns) -> Result<Self, Error> {
        let guess = Self::all().find(|guess| guess.name() == name);
        guess
            .filter(|guess| match guess.reference {
                Reference::Last => true,
                Reference::First => !known.coordinates.is_empty(),
                Reference::Second | Reference::Both => known.coordinates.len() >= 2,
            })
            .filter(|guess| guess.sharing != Sharing::Ring || known.ring.is_some())
            .ok_or(Error::Corrupt("a guess from what is not known"))
    }

    /// Returns the denominator for point `index`, as a float and as bits to repeat if it is not a number.
    #[inline(always)]
    fn reference(self, known: &ReferenceColumns, index: usize) -> (f64, u32) {
        let coordinate = |which: usize| {
            let bits = known.coordinates[which][index];
            (f64::from(f32::from_bits(bits)), bits)
        };
        match self.reference {
            Reference::Last => (1.0, 0),
            Reference::First => coordinate(0),
            Reference::Second => coordinate(1),
            Reference::Both => {
                let ((first, bits), (second, _)) = (coordinate(0), coordinate(1));
                ((first * first + second * second).sqrt(), bits)
            }
        }
    }
}

/// A quotient learned from the points that share it.
#[derive(Clone, Copy, Default)]
struct LearnedRatio {
    quotient: f64,
    points: u32,
}

/// Predicts point after point, learning from each.
struct Tracker<'a> {
    guess: CoordinatePredictor,
    known: &'a ReferenceColumns,
    width: usize,
    learned: Vec<LearnedRatio>,
    last: LearnedRatio,
    /// Number of points that the mean covers.
    memory: u32,
}

impl<'a> Tracker<'a> {
    fn new(guess: CoordinatePredictor, known: &'a ReferenceColumns, shape: Shape) -> Self {
        let (width, height) = match shape {
            Shape::Picture { width, height } => (width, height),
            Shape::Sequence(length) => (length, 1),
        };
        let slots = match guess.sharing {
            Sharing::All => 1,
            Sharing::Column => width,
            Sharing::Row => height,
            Sharing::Ring => RINGS,
        };
        let memory = match (guess.reference, guess.sharing) {
            (Reference::Last, _) | (_, Sharing::All) => 1,
            _ => 32,
        };
        Self {
            guess,
            known,
            width,
            learned: vec![LearnedRatio::default(); slots],
            last: LearnedRatio::default(),
            memory,
        }
    }

    #[inline(always)]
    fn slot(&self, index: usize) -> usize {
        match self.guess.sharing {
            Sharing::All => 0,
            Sharing::Column => index % self.width,
            Sharing::Row => index / self.width,
            Sharing::Ring => self.known.ring.as_ref().map_or(0, |ring| usize::from(ring[index]) % RINGS),
        }
    }

    /// Predicts the bits of point `index`; `tell` turns the prediction into the true value, from which to learn.
    #[inline(always)]
    fn next(&mut self, index: usize, tell: impl FnOnce(u32) -> u32) {
        let slot = self.slot(index);
        let (reference, bits) = self.guess.reference(self.known, index);
        let mut learned = self.learned[slot];
        if learned.points == 0 {
            learned.quotient = self.last.quotient;
        }
        let usable = reference.is_finite() && reference != 0.0;
        let product = (learned.quotient * reference) as f32;
        // The bits of NaN differ between processors.
        let guessed = if usable && !product.is_nan() { product.to_bits() } else { bits };
        let truth = f64::from(f32::from_bits(tell(guessed)));
        if usable && truth.is_finite() {
            learned.points = (learned.points + 1).min(self.memory);
            learned.quotient += (truth / reference - learned.quotient) / f64::from(learned.points);
            self.learned[slot] = learned;
            self.last = learned;
        }
    }
}

/// Returns the distance of every point from its prediction, in representable floats.
pub(super) fn differences(
    bits: &[u32],
    guess: CoordinatePredictor,
    known: &ReferenceColumns,
    shape: Shape,
) -> Vec<u32> {
    let mut tracker = Tracker::new(guess, known, shape);
    let mut differences = Vec::with_capacity(bits.len());
    for (index, &bits) in bits.iter().enumerate() {
        tracker.next(index, |guessed| {
            differences.push(zigzag(to_ordered_bits(bits).wrapping_sub(to_ordered_bits(guessed)) as i32));
            bits
        });
    }
    differences
}

/// The inverse of [`differences`].
pub(super) fn restore(
    differences: &[u32],
    guess: CoordinatePredictor,
    known: &ReferenceColumns,
    shape: Shape,
) -> Vec<u32> {
    let mut tracker = Tracker::new(guess, known, shape);
    let mut bits = Vec::with_capacity(differences.len());
    for (index, &difference) in differences.iter().enumerate() {
        tracker.next(index, |guessed| {
            let truth = from_ordered_bits(to_ordered_bits(guessed).wrapping_add(unzigzag(difference) as u32));
            bits.push(truth);
            truth
        });
    }
    bits
}

/// Returns the number of points to sample for the choice: four rows of a picture, within bounds.
fn sample_size(bits: &[u32], shape: Shape) -> usize {
    let rows = match shape {
        Shape::Picture { width, .. } => 4 * width,
        Shape::Sequence(_) => 0,
    };
    rows.clamp(2048, 8192).min(bits.len())
}

/// Returns the predictor that leaves less than the column's own neighbours do; `None` if none does.
pub(super) fn choose(bits: &[u32], known: &ReferenceColumns, shape: Shape) -> Option<CoordinatePredictor> {
    let some = sample_size(bits, shape);
    let mut best = (plain_cost(&bits[..some], shape), None);
    for guess in CoordinatePredictor::all().filter(|guess| guess.is_applicable(known, shape)) {
        let mut tracker = Tracker::new(guess, known, shape);
        let mut cost = 0u64;
        for (index, &bits) in bits[..some].iter().enumerate() {
            tracker.next(index, |guessed| {
                // The first half is for learning.
                let counts = u64::from(index >= some / 2);
                cost += counts * bit_length(to_ordered_bits(bits).wrapping_sub(to_ordered_bits(guessed)));
                bits
            });
        }
        if cost < best.0 {
            best = (cost, Some(guess));
        }
    }
    best.1
}

fn bit_length(difference: u32) -> u64 {
    u64::from(32 - zigzag(difference as i32).leading_zeros())
}

/// Returns the cost of the second half of a column when predicted from its neighbours.
fn plain_cost(sample: &[u32], shape: Shape) -> u64 {
    let half = (sample.len() / 2).max(1);
    if let Some(scale) = crate::scale::Scale::find(sample) {
        let multiples = sample.windows(2).skip(half - 1);
        let step = |pair: &[u32]| scale.multiple(pair[1]).wrapping_sub(scale.multiple(pair[0]));
        return multiples.map(|pair| bit_length(step(pair) as u32)).sum();
    }
    let above = match shape {
        Shape::Picture { width, .. } => width,
        Shape::Sequence(_) => 1,
    };
    let order = |index: usize| to_ordered_bits(sample[index]);
    let cost = |index: usize| {
        let west = bit_length(order(index).wrapping_sub(order(index - 1)));
        if index <= above {
            return west;
        }
        let plane = order(index - 1).wrapping_add(order(index - above)).wrapping_sub(order(index - above - 1));
        west.min(bit_length(order(index).wrapping_sub(plane)))
    };
    (half..sample.len()).map(cost).sum()
}
