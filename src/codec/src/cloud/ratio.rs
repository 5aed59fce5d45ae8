//! Coordinates guessed from coordinates.
//!
//! - A depth camera computes x = (u - cx)·z/f: within a column of pixels, x/z is one number. Likewise y/z in a row.
//! - A spinning laser computes z = r·sin ω and √(x² + y²) = r·cos ω: for one laser, their quotient is one number; and
//!   from shot to shot y/x hardly moves.
//! - Where nothing is known, the last point of the same laser is nearer than the last point.
//!
//! The quotient is learned from the points before. Everything is IEEE arithmetic (products, quotients, square roots),
//! so both sides learn the very same, whatever processors they have.

use super::Known;
use crate::Error;
use crate::column::{Shape, ordered, unordered};
use crate::predict::{unzigzag, zigzag};

/// What the quotient is taken to.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
enum Reference {
    /// Nothing: the last value is the guess.
    Last,
    /// The first coordinate told.
    First,
    /// The second.
    Second,
    /// √(first² + second²)
    Both,
}

/// Lasers told apart; more of them than any scanner has share quotients.
const RINGS: usize = 1024;

/// Which points share a quotient.
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

/// A way to guess a coordinate.
#[derive(Clone, Copy, PartialEq, Eq, Debug)]
pub(super) struct Guess {
    reference: Reference,
    sharing: Sharing,
}

const REFERENCES: [Reference; 4] = [
    Reference::Last,
    Reference::First,
    Reference::Second,
    Reference::Both,
];
const SHARINGS: [Sharing; 4] = [Sharing::All, Sharing::Column, Sharing::Row, Sharing::Ring];

impl Guess {
    fn all() -> impl Iterator<Item = Self> {
        REFERENCES.into_iter().flat_map(|reference| {
            SHARINGS
                .into_iter()
                .map(move |sharing| Self { reference, sharing })
        })
    }

    /// Whether it is of use at all, with what is known.
    fn applies(self, known: &Known, shape: Shape) -> bool {
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

    pub(super) fn named(name: u8, known: &Known) -> Result<Self, Error> {
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

    /// The reference of point `index`, as float and as bits to repeat when it is no number.
    #[inline(always)]
    fn reference(self, known: &Known, index: usize) -> (f64, u32) {
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
struct Learned {
    quotient: f64,
    points: u32,
}

/// Guesses point after point, learning from each.
struct Tracker<'a> {
    guess: Guess,
    known: &'a Known,
    width: usize,
    learned: Vec<Learned>,
    last: Learned,
    /// How many points the mean reaches back.
    memory: u32,
}

impl<'a> Tracker<'a> {
    fn new(guess: Guess, known: &'a Known, shape: Shape) -> Self {
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
            learned: vec![Learned::default(); slots],
            last: Learned::default(),
            memory,
        }
    }

    #[inline(always)]
    fn slot(&self, index: usize) -> usize {
        match self.guess.sharing {
            Sharing::All => 0,
            Sharing::Column => index % self.width,
            Sharing::Row => index / self.width,
            Sharing::Ring => self
                .known
                .ring
                .as_ref()
                .map_or(0, |ring| usize::from(ring[index]) % RINGS),
        }
    }

    /// Guesses the bits of point `index`; `tell` turns the guess into the truth, from which to learn.
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
        // The bits of what is no number differ between processors.
        let guessed = if usable && !product.is_nan() {
            product.to_bits()
        } else {
            bits
        };
        let truth = f64::from(f32::from_bits(tell(guessed)));
        if usable && truth.is_finite() {
            learned.points = (learned.points + 1).min(self.memory);
            learned.quotient += (truth / reference - learned.quotient) / f64::from(learned.points);
            self.learned[slot] = learned;
            self.last = learned;
        }
    }
}

/// How far every point is from its guess, in floats between.
pub(super) fn differences(bits: &[u32], guess: Guess, known: &Known, shape: Shape) -> Vec<u32> {
    let mut tracker = Tracker::new(guess, known, shape);
    let mut differences = Vec::with_capacity(bits.len());
    for (index, &bits) in bits.iter().enumerate() {
        tracker.next(index, |guessed| {
            differences.push(zigzag(ordered(bits).wrapping_sub(ordered(guessed)) as i32));
            bits
        });
    }
    differences
}

/// The inverse of [`differences`].
pub(super) fn restore(differences: &[u32], guess: Guess, known: &Known, shape: Shape) -> Vec<u32> {
    let mut tracker = Tracker::new(guess, known, shape);
    let mut bits = Vec::with_capacity(differences.len());
    for (index, &difference) in differences.iter().enumerate() {
        tracker.next(index, |guessed| {
            let truth = unordered(ordered(guessed).wrapping_add(unzigzag(difference) as u32));
            bits.push(truth);
            truth
        });
    }
    bits
}

/// How many points are looked at to choose: four rows of a picture, within bounds.
fn some(bits: &[u32], shape: Shape) -> usize {
    let rows = match shape {
        Shape::Picture { width, .. } => 4 * width,
        Shape::Sequence(_) => 0,
    };
    rows.clamp(2048, 8192).min(bits.len())
}

/// The guess that leaves less than the column's own neighbours do; `None` when none does.
pub(super) fn choose(bits: &[u32], known: &Known, shape: Shape) -> Option<Guess> {
    let some = some(bits, shape);
    let mut best = (plain_cost(&bits[..some], shape), None);
    for guess in Guess::all().filter(|guess| guess.applies(known, shape)) {
        let mut tracker = Tracker::new(guess, known, shape);
        let mut cost = 0u64;
        for (index, &bits) in bits[..some].iter().enumerate() {
            tracker.next(index, |guessed| {
                // The first half is for learning.
                let counts = u64::from(index >= some / 2);
                cost += counts * size(ordered(bits).wrapping_sub(ordered(guessed)));
                bits
            });
        }
        if cost < best.0 {
            best = (cost, Some(guess));
        }
    }
    best.1
}

fn size(difference: u32) -> u64 {
    u64::from(32 - zigzag(difference as i32).leading_zeros())
}

/// What the second half of a column costs when guessed from its neighbours.
fn plain_cost(sample: &[u32], shape: Shape) -> u64 {
    let half = (sample.len() / 2).max(1);
    if let Some(scale) = crate::scale::Scale::find(sample) {
        let multiples = sample.windows(2).skip(half - 1);
        let step = |pair: &[u32]| {
            scale
                .multiple(pair[1])
                .wrapping_sub(scale.multiple(pair[0]))
        };
        return multiples.map(|pair| size(step(pair) as u32)).sum();
    }
    let above = match shape {
        Shape::Picture { width, .. } => width,
        Shape::Sequence(_) => 1,
    };
    let order = |index: usize| ordered(sample[index]);
    let cost = |index: usize| {
        let west = size(order(index).wrapping_sub(order(index - 1)));
        if index <= above {
            return west;
        }
        let plane = order(index - 1)
            .wrapping_add(order(index - above))
            .wrapping_sub(order(index - above - 1));
        west.min(size(order(index).wrapping_sub(plane)))
    };
    (half..sample.len()).map(cost).sum()
}
