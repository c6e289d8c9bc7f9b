//! A recording through the emulated chip and through the core in process, side by side.

use core::error::Error;

use estimator::wire::link::Status;
use estimator::{Prepared, Walk};
use host_bridge::source::device::Fed;
use host_bridge::source::link::{Heard, Link};
use host_bridge::source::{Clock, Rate};
use host_bridge::stop::Stop;
use inference::Recording;
use inference::stream::{self, Core, Estimate};
use orbitcal::CoreModel;
use results::{EstimateRecord, FitResult, Names};
use twin::Ring;

use crate::qemu::{Counts, Emulator, Image, Options, Run};

/// Steps of a frame whose instructions are counted, by the words of the table and the function in the image.
pub const REGIONS: [(&str, &str); 8] = [
    ("decode", "Estimator::decode"),
    ("predict", "Estimator::predict"),
    ("screen", "screen"),
    ("condition", "Estimator::condition"),
    ("solve", "Posterior::solve"),
    ("ingest", "Estimator::ingest"),
    ("encode", "Reply::encode"),
    ("slice", "Estimator::prepare"),
];

/// What a run on the chip showed beside the same frames in process.
#[derive(Debug)]
pub struct Comparison {
    /// Frames that went through both.
    pub frames: usize,
    /// Sequence numbers of frames whose estimates differ in any bit.
    pub different: Vec<u32>,
    /// Frames that the chip answered while it was getting ready for them.
    pub interrupting: usize,
    /// How the device was at the end.
    pub status: Status,
    /// Instructions of each region.
    pub counts: Counts,
    /// The device's result for a person.
    pub result: FitResult,
}

/// Run the first `frames` of a recording through the chip and in process; `hear` gets each of the chip's estimates.
///
/// # Errors
/// Whatever stops the emulator, the line or the core.
pub fn compare(
    image: &Image,
    (ring, recording): (&Ring, &Recording),
    walk: Walk,
    count: bool,
    mut hear: impl FnMut(&EstimateRecord) -> Result<(), Box<dyn Error>>,
) -> Result<Comparison, Box<dyn Error>> {
    let regions = if count {
        REGIONS.map(|(_, name)| image.function(name)).into_iter().collect::<Result<_, _>>()?
    } else {
        vec![]
    };
    let emulator = Emulator::start(image, &Options { regions, ..Options::default() })?;
    let heard = side_by_side(&emulator, (ring, recording), walk, &mut hear);
    let run = emulator.stop()?;
    let comparison = heard.map_err(|error| format!("{error}; {}", last_words(image, &run)))?;
    Ok(Comparison { counts: run.counts, ..comparison })
}

/// What a chip that no longer answers left behind: its log, and what the emulator said.
fn last_words(image: &Image, run: &Run) -> String {
    let log = match image.log(&run.stdout) {
        Ok(log) => log.iter().map(|line| line.message.as_str()).collect::<Vec<_>>().join("; "),
        Err(error) => error.to_string(),
    };
    format!("the device's log: {log}; the emulator: {}", run.stderr)
}

fn side_by_side(
    emulator: &Emulator,
    (ring, recording): (&Ring, &Recording),
    walk: Walk,
    hear: &mut impl FnMut(&EstimateRecord) -> Result<(), Box<dyn Error>>,
) -> Result<Comparison, Box<dyn Error>> {
    let mut core = stream::estimator(ring, recording, walk)?;
    let mut link = Link::new(emulator.uart());
    link.restart(&core.setup)?;
    let (names, clock) = (Names::of(ring), Clock::new(Rate::Max, &Stop::default()));
    let mut fed = Fed::new(recording, &names, &mut link, clock);
    let (mut different, mut interrupting, mut last) = (Vec::new(), 0, None);
    for row in &recording.rows {
        let heard = fed.advance().map_err(|error| error.to_string())?.expect("one reply a row");
        for _ in 0..heard.estimate.remarks.slices {
            let _ = core.slice();
        }
        interrupting += usize::from(core.clone().slice() != Prepared::Nothing);
        if !is_same(&mut core, stream::wire(recording, row)?, &heard) {
            different.push(row.sequence);
        }
        let record = heard.record(&names);
        hear(&record)?;
        last = Some(record);
    }
    let (last, quality, timing) = (last.ok_or("no frames")?, fed.quality()?, fed.times.quantiles());
    let status = link.status()?;
    Ok(Comparison {
        frames: recording.rows.len(),
        different,
        interrupting,
        status,
        counts: Counts::new(),
        result: FitResult::of_core(CoreModel::Green.word(), ring, (recording, walk), &last, quality, timing)?,
    })
}

/// True if the core in process gives the same for a frame, bit for bit: the whole estimate, and the covariance.
pub fn is_same(core: &mut Core, mut wire: Vec<u8>, heard: &Heard) -> bool {
    let Ok(estimate) = core.ingest(&mut wire) else { return false };
    let mut places = (0..estimate.mean.len()).flat_map(|i| (0..=i).map(move |j| (i, j)));
    bits(&estimate) == bits(&heard.estimate)
        && places.all(|(i, j)| core.covariance(i, j).to_bits() == heard.covariance(i, j).to_bits())
}

/// All of an estimate, to the bit.
pub fn bits(e: &Estimate) -> Vec<u64> {
    let lists = [&e.mean, &e.sigma, &e.map_params, &e.centre, &e.params_sigma].into_iter().flatten();
    let floats = lists.chain([&e.nis, &e.log_evidence]).map(|v| u64::from(v.to_bits()));
    let health = e.health.iter().flat_map(|h| {
        [h.state as u64, u64::from(h.noise.to_bits()), u64::from(h.weighted_as.to_bits()), u64::from(h.rejected)]
    });
    let remarks = [e.remarks.put_aside, e.remarks.baselines_moved, e.remarks.unsolved].map(u64::from);
    let numbers = [e.sequence, e.frames, e.rejected_frames, u32::from(e.linearised), e.remarks.slices].map(u64::from);
    let masks = [&e.clipped, &e.accepted, &e.rejected, &e.confirmed, &e.restarted].into_iter().flatten();
    let masks = masks.map(|bit| u64::from(*bit));
    let tunes = e.tune_innovation.map(|tune| tune.map_or(u64::MAX, |tune| u64::from(tune.to_bits())));
    let [setting, loose] = [e.setting, e.remarks.let_loose].map(|index| index.map_or(u64::MAX, u64::from));
    let rest = [e.time_us, setting, loose, tunes[0], tunes[1]];
    numbers.into_iter().chain(remarks).chain(masks).chain(rest).chain(floats).chain(health).collect()
}

/// Most instructions of each region, in the order of [`REGIONS`]: of a slice in the whole run, of a frame in its second half. By then it is known where the
/// correctors stand, and no var is at a bound.
pub fn largest(counts: &Counts) -> Vec<(&'static str, u64)> {
    let most = |(word, name): &(&'static str, &str)| {
        let runs = counts.get(*name).map_or(&[][..], Vec::as_slice);
        let first = if *word == "slice" { 0 } else { runs.len() / 2 };
        (*word, runs[first..].iter().copied().max().unwrap_or(0))
    };
    REGIONS.iter().map(most).collect()
}
