//! One bit for each monitor, or for each param, however many there are.

use crate::state::{Bytes, State, StateError};

/// `32 W` bits, all 0 at first; bit `i` is that of monitor, or param, `i`.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Mask<const W: usize>([u32; W]);

impl<const W: usize> State for Mask<W> {
    fn pass(&mut self, bytes: &mut impl Bytes) -> Result<(), StateError> {
        self.0.pass(bytes)
    }
}

/// Words of 32 bits that hold so many bits.
pub const fn words(bits: usize) -> usize {
    bits.div_ceil(32)
}

impl<const W: usize> Mask<W> {
    /// No bit.
    pub const NONE: Self = Self([0; W]);

    /// The mask of these words, bit `i` of the mask being bit `i % 32` of word `i / 32`; words beyond the last are left out.
    pub fn from_words(words: &[u32]) -> Self {
        let mut mask = Self::NONE;
        mask.0.iter_mut().zip(words).for_each(|(to, word)| *to = *word);
        mask
    }

    /// Its words.
    pub fn as_words(&self) -> &[u32] {
        &self.0
    }

    /// Bit `i`; none beyond the last is 1.
    pub fn has(&self, i: usize) -> bool {
        self.0.get(i / 32).is_some_and(|word| word >> (i % 32) & 1 == 1)
    }

    /// Set or clear bit `i`.
    pub fn put(&mut self, i: usize, bit: bool) {
        if let Some(word) = self.0.get_mut(i / 32) {
            *word = *word & !(1 << (i % 32)) | u32::from(bit) << (i % 32);
        }
    }

    /// Number of bits that are 1.
    pub fn count(&self) -> u32 {
        self.0.iter().map(|word| word.count_ones()).sum()
    }

    /// No bit is 1.
    pub fn is_empty(&self) -> bool {
        self.0.iter().all(|word| *word == 0)
    }
}

impl<const W: usize> Default for Mask<W> {
    fn default() -> Self {
        Self::NONE
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_bit_is_its_own() {
        let mut mask = Mask::<2>::NONE;
        for i in [0, 31, 32, 63] {
            mask.put(i, true);
            assert!(mask.has(i));
        }
        assert_eq!((mask.count(), mask.as_words()), (4, [0x8000_0001; 2].as_slice()));
        mask.put(31, false);
        assert!(!mask.has(31) && mask.has(32) && !mask.is_empty());
    }

    #[test]
    fn there_is_nothing_beyond_the_last() {
        let mut mask = Mask::<1>::NONE;
        mask.put(32, true);
        assert!(mask.is_empty() && !mask.has(32) && words(32) == 1 && words(33) == 2);
    }
}
