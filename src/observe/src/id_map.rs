//! Map that assigns ids to its values.

use std::collections::BTreeMap;

/// Maximum number of values at once.
pub(crate) const MAX_VALUES: usize = 2000;

/// Map with a bounded number of values, each under an id that is never reused, so that a late message is not
/// attributed to another topic.
#[derive(Debug)]
pub(crate) struct IdMap<T> {
    all: BTreeMap<u32, T>,
    next: u32,
}

impl<T> Default for IdMap<T> {
    fn default() -> Self {
        Self { all: BTreeMap::new(), next: 0 }
    }
}

impl<T> IdMap<T> {
    /// Returns the id of the first value that satisfies the predicate.
    pub fn find(&self, mut is: impl FnMut(&T) -> bool) -> Option<u32> {
        let found = self.all.iter().find(|(_, one)| is(one));
        found.map(|(number, _)| *number)
    }

    /// Adds a value and returns its id; `None` if the map is full.
    pub fn add(&mut self, one: T) -> Option<u32> {
        if self.is_full() {
            return None;
        }
        let number = self.next;
        self.next = number.checked_add(1)?;
        self.all.insert(number, one);
        Some(number)
    }

    /// Returns true if no more values can be added.
    pub fn is_full(&self) -> bool {
        self.all.len() >= MAX_VALUES
    }

    /// Returns the value with this id.
    pub fn get(&self, number: u32) -> Option<&T> {
        self.all.get(&number)
    }

    /// Returns the value with this id for modification.
    pub fn get_mut(&mut self, number: u32) -> Option<&mut T> {
        self.all.get_mut(&number)
    }

    /// Iterates over ids and values.
    pub fn iter_mut(&mut self) -> impl Iterator<Item = (u32, &mut T)> {
        self.all.iter_mut().map(|(number, one)| (*number, one))
    }

    /// Removes the values that do not satisfy the predicate.
    pub fn retain(&mut self, mut stays: impl FnMut(u32, &T) -> bool) {
        self.all.retain(|number, one| stays(*number, one));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn ids_are_bounded_and_never_reused() {
        let mut numbered = IdMap::default();
        for index in 0..MAX_VALUES {
            assert_eq!(numbered.add(index), u32::try_from(index).ok());
        }
        assert_eq!(numbered.add(MAX_VALUES), None);
        numbered.retain(|number, _| number != 7);
        let new = numbered.add(MAX_VALUES).expect("room again");
        assert_eq!((numbered.get(7), numbered.get(new)), (None, Some(&MAX_VALUES)));
        assert_eq!(numbered.find(|one| *one == MAX_VALUES), Some(new));
        assert!(numbered.is_full());
    }
}
