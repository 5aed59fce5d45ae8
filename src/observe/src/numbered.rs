//! What is heard, by number.

use std::collections::BTreeMap;

/// Numbers that are in use at once.
pub(crate) const MOST: usize = 2000;

/// So many things at most, by number. No number is used again: a message that comes late is not taken for another topic's.
#[derive(Debug)]
pub(crate) struct Numbered<T> {
    all: BTreeMap<u32, T>,
    next: u32,
}

impl<T> Default for Numbered<T> {
    fn default() -> Self {
        Self {
            all: BTreeMap::new(),
            next: 0,
        }
    }
}

impl<T> Numbered<T> {
    /// The number of the first that is so.
    pub fn find(&self, mut is: impl FnMut(&T) -> bool) -> Option<u32> {
        let found = self.all.iter().find(|(_, one)| is(one));
        found.map(|(number, _)| *number)
    }

    /// Adds one; its number. None: there are too many.
    pub fn add(&mut self, one: T) -> Option<u32> {
        if self.is_full() {
            return None;
        }
        let number = self.next;
        self.next = number.checked_add(1)?;
        self.all.insert(number, one);
        Some(number)
    }

    /// Whether one more finds no room.
    pub fn is_full(&self) -> bool {
        self.all.len() >= MOST
    }

    /// Of this number.
    pub fn get(&self, number: u32) -> Option<&T> {
        self.all.get(&number)
    }

    /// Of this number.
    pub fn get_mut(&mut self, number: u32) -> Option<&mut T> {
        self.all.get_mut(&number)
    }

    /// Those that are there, by number.
    pub fn iter_mut(&mut self) -> impl Iterator<Item = (u32, &mut T)> {
        self.all.iter_mut().map(|(number, one)| (*number, one))
    }

    /// Lets go of those that are not so.
    pub fn retain(&mut self, mut stays: impl FnMut(u32, &T) -> bool) {
        self.all.retain(|number, one| stays(*number, one));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn there_are_so_many_at_once_and_no_number_comes_again() {
        let mut numbered = Numbered::default();
        for index in 0..MOST {
            assert_eq!(numbered.add(index), u32::try_from(index).ok());
        }
        assert_eq!(numbered.add(MOST), None);
        numbered.retain(|number, _| number != 7);
        let new = numbered.add(MOST).expect("room again");
        assert_eq!((numbered.get(7), numbered.get(new)), (None, Some(&MOST)));
        assert_eq!(numbered.find(|one| *one == MOST), Some(new));
        assert!(numbered.is_full());
    }
}
