//! A recording through the emulated chip and through the core in process, side by side.

use core::error::Error;

use estimator::booster::Estimate;
use firmware_sim::link::Status;
use host_bridge::answer::Answer;
use host_bridge::cli::Rate;
use host_bridge::command::replay::Clock;
use host_bridge::command::{CommandError, serve};
use host_bridge::link::{Heard, Link};
use inference::Recording;
use inference::stream::{self, Core};
use twin::Ring;

use crate::qemu::{Counts, Emulator, Image, Options};

/// Steps of a frame whose instructions are counted, by the words of the table and the function in the image.
pub const REGIONS: [(&str, &str); 8] = [
    ("decode", "Estimator::decode"),
    ("predict", "Estimator::predict"),
    ("screen", "screen"),
    ("condition", "Estimator::condition"),
    ("ingest", "Estimator::ingest"),
    ("encode", "Reply::encode"),
    ("linearise", "linearise_anew"),
    ("attempt", "linearise_at"),
];

/// What a run on the chip showed beside the same frames in process.
#[derive(Debug)]
pub struct Comparison {
    /// Frames that went through both.
    pub frames: usize,
    /// Sequence numbers of frames whose answers differ in any bit.
    pub different: Vec<u32>,
    /// How the device was at the end.
    pub status: Status,
    /// Instructions of each region.
    pub counts: Counts,
    /// The device's answer for a person.
    pub answer: Answer,
}

/// Run the first `frames` of a recording through the chip and in process; `hear` gets each of the chip's answers.
///
/// # Errors
/// Whatever stops the emulator, the line or the core.
pub fn compare(
    image: &Image,
    (ring, recording): (&Ring, &Recording),
    process_noise: f32,
    count: bool,
    mut hear: impl FnMut(&Heard) -> Result<(), CommandError>,
) -> Result<Comparison, Box<dyn Error>> {
    let regions = if count {
        REGIONS.map(|(_, name)| image.function(name)).into_iter().collect::<Result<_, _>>()?
    } else {
        vec![]
    };
    let emulator = Emulator::start(image, &Options { regions, ..Options::default() })?;
    let mut core = stream::estimator(ring, recording, process_noise)?;
    let mut link = Link::new(emulator.uart());
    link.restart(&core.setup)?;
    let mut rows = recording.rows.iter();
    let mut different = Vec::new();
    let fed = serve::replay(&mut link, recording, Clock::new(Rate::Max), |heard| {
        let row = rows.next().expect("one answer a row");
        let wire = stream::wire(recording, row)?;
        if !is_same(&mut core, wire, heard) {
            different.push(row.sequence);
        }
        hear(heard)
    });
    let fed = fed.map_err(|error| format!("{error:?}"))?;
    let status = link.status()?;
    let counts = emulator.stop()?.counts;
    Ok(Comparison {
        frames: recording.rows.len(),
        different,
        status,
        counts,
        answer: fed.answer(ring, recording, &core.setup),
    })
}

/// True if the core in process says the same of a frame, bit for bit: the whole estimate, and the covariance.
fn is_same(core: &mut Core, mut wire: Vec<u8>, heard: &Heard) -> bool {
    core.prepare();
    let Ok(estimate) = core.ingest(&mut wire) else { return false };
    let mut places = (0..48).flat_map(|i| (0..=i).map(move |j| (i, j)));
    bits(&estimate) == bits(&heard.estimate)
        && places.all(|(i, j)| core.covariance(i, j).to_bits() == heard.covariance(i, j).to_bits())
}

/// Everything that an estimate says, to the bit.
pub fn bits(e: &Estimate) -> Vec<u64> {
    let lists = [&e.mean, &e.sigma, &e.map_params, &e.centre, &e.params_sigma].into_iter().flatten();
    let floats = lists.chain([&e.nis, &e.log_evidence]).map(|v| u64::from(v.to_bits()));
    let health = e.health.iter().flat_map(|h| {
        [h.state as u64, u64::from(h.noise.to_bits()), u64::from(h.weighted_as.to_bits()), u64::from(h.rejected)]
    });
    let numbers = [e.sequence, e.frames, e.rejected_frames, u32::from(e.linearised)].map(u64::from);
    let masks = [e.time_us, e.clipped, e.accepted, e.rejected, e.confirmed, e.restarted];
    let setting = e.setting.map_or(u64::MAX, u64::from);
    numbers.into_iter().chain(masks).chain([setting]).chain(floats).chain(health).collect()
}

/// Most instructions of each region in a run, in the order of [`REGIONS`].
pub fn largest(counts: &Counts) -> Vec<(&'static str, u64)> {
    let most = |name: &str| counts.get(name).and_then(|runs| runs.iter().max()).copied().unwrap_or(0);
    REGIONS.iter().map(|(word, name)| (*word, most(name))).collect()
}
