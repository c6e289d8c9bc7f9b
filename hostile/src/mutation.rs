//! Good bytes with some of them changed.

use core::ops::Range;

use rand::rngs::StdRng;
use rand::{RngExt, SeedableRng};

/// Most changes of one input.
const CHANGES: usize = 4;
/// Longest stretch that is moved, repeated or left out [B].
const STRETCH: usize = 256;
/// Numbers that are too large, too small, or none.
const NUMBERS: [&str; 20] = [
    "0",
    "-0",
    "1",
    "-1",
    "2",
    "65536",
    "4294967295",
    "4294967296",
    "18446744073709551615",
    "18446744073709551616",
    "1e15",
    "-1e15",
    "1e16",
    "1e300",
    "1e999",
    "5e-324",
    "NaN",
    "inf",
    "null",
    "",
];
/// Words of four and eight bytes at the ends of their ranges.
const WORDS: [u64; 8] = [0, 1, 0x7f, 0x7fff_ffff, 0x8000_0000, 0xffff_ffff, 0x7fff_ffff_ffff_ffff, u64::MAX];

/// Makes inputs of seeds, the same for the same number.
#[derive(Debug)]
pub struct Mutator {
    seeds: Vec<Vec<u8>>,
}

impl Mutator {
    /// Of good inputs.
    pub fn new(seeds: Vec<Vec<u8>>) -> Self {
        Self { seeds }
    }

    /// One input of any number of them.
    ///
    /// # Panics
    /// Without a seed.
    pub fn input(&self, number: u64) -> Vec<u8> {
        let mut random = StdRng::seed_from_u64(number);
        let mut input = self.seeds[random.random_range(0..self.seeds.len())].clone();
        for _ in 0..random.random_range(1..=CHANGES) {
            self.change(&mut input, &mut random);
        }
        input
    }

    fn change(&self, input: &mut Vec<u8>, random: &mut StdRng) {
        let other = &self.seeds[random.random_range(0..self.seeds.len())];
        let here = stretch(input, random);
        match random.random_range(0..11) {
            0 => flip(input, random),
            1 => input.truncate(here.start),
            2 => drop(input.drain(here)),
            3 => repeat(input, here, random),
            4 => drop(input.splice(here, other[stretch(other, random)].iter().copied())),
            5 => word(input, here.start, random),
            6..9 => replace(input, random, is_of_a_number, |random| pick(&NUMBERS, random).as_bytes().to_vec()),
            9 => {
                let from = words(other, is_of_a_word);
                let text = from.get(random.random_range(0..from.len().max(1))).map(|at| other[at.clone()].to_vec());
                replace(input, random, is_of_a_word, |_| text.clone().unwrap_or_default());
            }
            _ => line(input, random),
        }
    }
}

fn pick<'a, T: ?Sized>(from: &[&'a T], random: &mut StdRng) -> &'a T {
    from[random.random_range(0..from.len())]
}

/// A part of bytes, perhaps an empty one.
fn stretch(bytes: &[u8], random: &mut StdRng) -> Range<usize> {
    let start = random.random_range(0..=bytes.len());
    start..(start + random.random_range(0..=STRETCH)).min(bytes.len())
}

fn flip(input: &mut [u8], random: &mut StdRng) {
    if !input.is_empty() {
        let at = random.random_range(0..input.len());
        input[at] ^= 1 << random.random_range(0..8);
    }
}

/// A stretch again and again, now and then so often that counts become large.
fn repeat(input: &mut Vec<u8>, here: Range<usize>, random: &mut StdRng) {
    let times = if random.random_range(0..50) == 0 { 2000 } else { random.random_range(1..8) };
    let copies = input[here.clone()].repeat(times);
    drop(input.splice(here.end..here.end, copies));
}

/// Bytes of a number at the end of its range.
fn word(input: &mut [u8], at: usize, random: &mut StdRng) {
    let bytes = WORDS[random.random_range(0..WORDS.len())].to_le_bytes();
    let length = [1, 2, 4, 8][random.random_range(0..4)];
    for (to, from) in input[at..].iter_mut().zip(&bytes[..length]) {
        *to = *from;
    }
}

fn is_of_a_number(byte: u8) -> bool {
    byte.is_ascii_digit() || b"+-.eE".contains(&byte)
}

fn is_of_a_word(byte: u8) -> bool {
    byte.is_ascii_alphanumeric() || byte == b'_'
}

/// Where words stand.
fn words(bytes: &[u8], is_part: fn(u8) -> bool) -> Vec<Range<usize>> {
    let is = |at: usize| bytes.get(at).is_some_and(|byte| is_part(*byte));
    let starts = (0..bytes.len()).filter(|at| is(*at) && (*at == 0 || !is(at - 1)));
    starts.map(|start| start..(start..).find(|at| !is(*at)).unwrap_or(bytes.len())).collect()
}

fn replace(
    input: &mut Vec<u8>,
    random: &mut StdRng,
    is_part: fn(u8) -> bool,
    with: impl FnOnce(&mut StdRng) -> Vec<u8>,
) {
    let words = words(input, is_part);
    if !words.is_empty() {
        let at = words[random.random_range(0..words.len())].clone();
        drop(input.splice(at, with(random)));
    }
}

/// A line left out, or one more of it elsewhere.
fn line(input: &mut Vec<u8>, random: &mut StdRng) {
    let mut lines: Vec<Vec<u8>> = input.split_inclusive(|byte| *byte == b'\n').map(<[u8]>::to_vec).collect();
    if !lines.is_empty() {
        let line = lines.remove(random.random_range(0..lines.len()));
        if random.random() {
            lines.insert(random.random_range(0..=lines.len()), line.clone());
            lines.insert(random.random_range(0..=lines.len()), line);
        }
        *input = lines.concat();
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn inputs_are_the_same_for_the_same_number_and_differ_else() {
        let mutator = Mutator::new(vec![b"{\"length\": 1.5, \"name\": \"QF\"}\n".repeat(10), vec![]]);
        let inputs: Vec<Vec<u8>> = (0..500).map(|number| mutator.input(number)).collect();
        assert!((0..500).all(|number| mutator.input(number) == inputs[number as usize]));
        let distinct: std::collections::BTreeSet<_> = inputs.iter().collect();
        assert!(distinct.len() > 200, "{}", distinct.len());
        assert!(inputs.iter().any(|input| String::from_utf8_lossy(input).contains("1e999")));
    }

    #[test]
    fn words_are_found() {
        assert_eq!(words(b"a = -1.5e3; b2", is_of_a_number), [4..10, 13..14]);
        assert_eq!(words(b"", is_of_a_word), []);
    }
}
