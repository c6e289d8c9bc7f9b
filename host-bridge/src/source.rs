//! Where estimates come from: the core in this process fed by a recording or by raw frames, or a device on a line.

pub mod address;
pub mod desk;
pub mod device;
pub mod feed;
pub mod link;
pub mod origin;
pub mod program;
pub mod queue;
pub mod rehearsal;
pub mod replay;
pub mod shared;
pub mod splitter;

use core::str::FromStr;
use core::time::Duration;
use std::time::Instant;

use estimator::Prepared;
use results::{EstimateRecord, Remarked, Timing};
use twin::limits::Range;

use crate::stop::Stop;

/// Why a source gives no more.
pub type SourceError = Box<dyn core::error::Error + Send + Sync>;

/// What a source gives next.
pub enum Next {
    /// An estimate.
    Estimate(Box<EstimateRecord>),
    /// Nothing yet: time to look whether anybody wants more.
    Nothing,
    /// Nothing ever again.
    End,
}

/// A place that estimates come from, one a frame.
pub trait Source {
    /// Wait for the next estimate, a second at most where nobody here has sent its frame.
    ///
    /// # Errors
    /// Whatever ends the stream before its end.
    fn next(&mut self) -> Result<Next, SourceError>;

    /// What was remarked of the frames before the next one, where others than those that were given here count.
    fn remarked(&self) -> Remarked {
        Remarked::default()
    }
}

/// Frames a second.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Rate {
    /// As fast as possible.
    Max,
    /// This many a second [Hz].
    Hertz(f64),
}

/// Rates of a recording, from one frame a day.
const RATES: Range = Range::new(1e-5, 1e6, "Hz or max");

impl FromStr for Rate {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        if text == "max" { Ok(Self::Max) } else { RATES.parse(text).map(Self::Hertz) }
    }
}

/// Releases frames at a fixed rate, without drift.
#[derive(Debug)]
pub struct Clock {
    start: Instant,
    period: Option<Duration>,
    ticks: u32,
    stop: Stop,
}

impl Clock {
    /// Begin now.
    pub fn new(rate: Rate, stop: &Stop) -> Self {
        let period = match rate {
            Rate::Max => None,
            Rate::Hertz(hertz) => Some(Duration::from_secs_f64(1.0 / hertz)),
        };
        Self { start: Instant::now(), period, ticks: 0, stop: stop.clone() }
    }

    /// Wait for the next release, or for somebody to ask for the end.
    pub fn wait(&mut self) {
        let Some(period) = self.period else { return };
        self.stop.sleep_until(self.start + period * self.ticks);
        self.ticks += 1;
    }
}

/// How long each frame took: what was done between the one before and it, slice by slice, and the answer to it.
#[derive(Debug, Default)]
pub struct Times {
    answers: Vec<Duration>,
    preparations: Vec<Preparation>,
}

/// Work between two frames.
#[derive(Debug, Clone, Copy, Default)]
struct Preparation {
    /// The longest slice: a frame that comes at its beginning waits for its end.
    longest: Duration,
    /// All slices.
    all: Duration,
}

impl Times {
    /// Run what answers a frame, and note how long it took.
    pub fn of<T>(&mut self, answer: impl FnOnce() -> T) -> T {
        timed(&mut self.answers, answer)
    }

    /// Run the slices that prepare for a frame, until there is nothing to do, and note how long they took.
    pub fn preparing(&mut self, mut slice: impl FnMut() -> Prepared) {
        let (mut slices, mut prepared) = (Vec::new(), Prepared::Slice);
        while prepared != Prepared::Nothing {
            prepared = timed(&mut slices, &mut slice);
        }
        let longest = slices.iter().copied().max().unwrap_or_default();
        self.preparations.push(Preparation { longest, all: slices.iter().sum() });
    }

    /// Median, 99th percentile and largest of the answer, of the whole frame, and of the frame with all that is done before the next
    /// one, as far as preparations were seen: a device prepares by itself.
    pub fn quantiles(&self) -> Timing {
        let preparations = self.preparations.iter().copied().chain(core::iter::repeat(Preparation::default()));
        let each = self.answers.iter().zip(preparations);
        let whole = each.clone().map(|(answer, preparation)| *answer + preparation.longest);
        let all = each.map(|(answer, preparation)| *answer + preparation.all);
        let [update_us_p50, update_us_p99, update_us_max] = quantiles(self.answers.clone());
        let [frame_us_p50, frame_us_p99, frame_us_max] = quantiles(whole.collect());
        let [prepared_us_p50, prepared_us_p99, prepared_us_max] = quantiles(all.collect());
        Timing {
            update_us_p50,
            update_us_p99,
            update_us_max,
            frame_us_p50,
            frame_us_p99,
            frame_us_max,
            prepared_us_p50,
            prepared_us_p99,
            prepared_us_max,
        }
    }
}

fn timed<T>(times: &mut Vec<Duration>, run: impl FnOnce() -> T) -> T {
    let start = Instant::now();
    let value = run();
    times.push(start.elapsed());
    value
}

/// Median, 99th percentile and largest [us]; 0 of nothing.
fn quantiles(mut times: Vec<Duration>) -> [f64; 3] {
    times.sort_unstable();
    [0.5, 0.99, 1.0].map(|p| {
        let index = (p * times.len() as f64) as usize;
        times.get(index.min(times.len().saturating_sub(1))).map_or(0.0, |time| time.as_secs_f64() * 1e6)
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_whole_frame_waits_for_one_slice_of_its_preparation() {
        let ms = Duration::from_millis;
        let preparation = |longest, all| Preparation { longest: ms(longest), all: ms(all) };
        let times = Times {
            answers: [1, 3, 2].map(ms).to_vec(),
            preparations: vec![preparation(10, 30), preparation(7, 10), preparation(9, 20)],
        };
        let Timing { update_us_max, frame_us_p50, frame_us_max, prepared_us_p50, prepared_us_max, .. } =
            times.quantiles();
        assert_eq!([update_us_max, frame_us_p50, frame_us_max], [3e3, 11e3, 11e3]);
        assert_eq!([prepared_us_p50, prepared_us_max], [22e3, 31e3]);
        assert_eq!(Times::default().quantiles().frame_us_p99, 0.0);
    }

    #[test]
    fn preparing_ends_with_nothing_to_do() {
        let (mut times, mut left) = (Times::default(), 3);
        times.preparing(|| {
            left -= 1;
            if left > 0 { Prepared::Slice } else { Prepared::Nothing }
        });
        assert_eq!((left, times.preparations.len()), (0, 1));
        assert!(times.preparations[0].longest <= times.preparations[0].all);
    }

    #[test]
    fn rates_are_numbers_or_max() {
        assert_eq!("max".parse(), Ok(Rate::Max));
        assert_eq!("1000".parse(), Ok(Rate::Hertz(1000.0)));
        for wrong in ["0", "-1", "nan", "inf", "fast"] {
            assert!(wrong.parse::<Rate>().is_err(), "{wrong}");
        }
    }
}
