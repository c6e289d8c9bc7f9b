//! A byte stream cut into packets at its zero bytes, in bounded memory.

/// Cuts bytes into packets.
#[derive(Debug)]
pub struct Splitter {
    partial: Vec<u8>,
    most: usize,
    /// What comes up to the next zero belongs to a packet that is too long.
    skips: bool,
}

impl Splitter {
    /// For packets of at most so many bytes.
    pub fn new(most: usize) -> Self {
        Self { partial: Vec::new(), most, skips: false }
    }

    /// Take bytes in, hand out each packet with its zero; returns how many packets were too long.
    pub fn push(&mut self, mut bytes: &[u8], mut each: impl FnMut(Vec<u8>)) -> u64 {
        let mut long = 0;
        while let Some(end) = bytes.iter().position(|byte| *byte == 0) {
            let (packet, rest) = bytes.split_at(end + 1);
            long += self.add(packet);
            let whole = core::mem::take(&mut self.partial);
            // a zero alone is a pause of the line
            if whole.len() > 1 {
                each(whole);
            }
            (bytes, self.skips) = (rest, false);
        }
        long + self.add(bytes)
    }

    /// The stream has ended: true if it ended within a packet.
    pub fn end(&mut self) -> bool {
        let is_within = !self.partial.is_empty() || self.skips;
        self.partial.clear();
        self.skips = false;
        is_within
    }

    /// One more part of a packet; 1 if that makes it too long.
    fn add(&mut self, part: &[u8]) -> u64 {
        if self.skips {
            return 0;
        }
        self.skips = self.partial.len() + part.len() > self.most;
        if self.skips {
            self.partial.clear();
        } else {
            self.partial.extend_from_slice(part);
        }
        u64::from(self.skips)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn split(parts: &[&[u8]]) -> (Vec<Vec<u8>>, u64, bool) {
        let (mut splitter, mut packets) = (Splitter::new(4), Vec::new());
        let long = parts.iter().map(|part| splitter.push(part, |packet| packets.push(packet))).sum();
        (packets, long, splitter.end())
    }

    #[test]
    fn packets_are_the_same_however_the_bytes_come() {
        let stream = [1, 2, 0, 0, 3, 0, 9, 9, 9, 9, 9, 0, 4, 5, 6, 0, 7];
        let whole = split(&[&stream]);
        assert_eq!(whole, (vec![vec![1, 2, 0], vec![3, 0], vec![4, 5, 6, 0]], 1, true));
        for at in 0..stream.len() {
            let (one, two) = stream.split_at(at);
            assert_eq!(split(&[one, two]), whole, "cut at {at}");
        }
        assert_eq!(split(&stream.iter().map(core::slice::from_ref).collect::<Vec<_>>()), whole);
    }

    #[test]
    fn a_stream_without_a_zero_takes_no_memory() {
        let mut splitter = Splitter::new(4);
        let long: u64 = (0..1000).map(|_| splitter.push(&[7; 100], |_| ())).sum();
        assert_eq!((long, splitter.partial.len()), (1, 0));
    }
}
