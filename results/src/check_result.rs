//! The result of `orbitcal check`: what a recording holds, and what each command can do with it.

use core::fmt;
use estimator::Walk;

use comfy_table::CellAlignment;
use diagnosis::{DataError, Miswired};
use inference::stream::{self, Core};
use inference::{BaseModel, BatchFit, Campaign, Imperfection, Lack, Recording, TuneUse};
use schemars::JsonSchema;
use serde::Serialize;
use training::rooms::largest;
use twin::{Hold, Optics, Ring, Tunes, median};

use crate::campaign::{campaign, not_modelled, strays};
use crate::error::CommandError;
use crate::fit_result::{Monitor, TunesMeasured, faults, lack, monitors};
use crate::imperfection::ImperfectionResult;
use crate::output::{lines, table};

/// Fewest monitors with readings, and correctors that were moved, for a diagnosis.
const LEAST: usize = diagnosis::LEAST;
/// Rate of a device's serial line where none is given [baud], and bits of a byte on it.
const LINE: (f64, f64) = (921_600.0, 10.0);

/// What a recording holds. Field names are those of the command's JSON.
#[derive(Debug, Serialize, JsonSchema)]
pub struct CheckResult {
    recording: String,
    machine: String,
    frames: usize,
    /// Frames that the counter has passed over.
    lost_frames: u64,
    seconds: f64,
    /// Times in the cycle, of a machine with a ramp [ms].
    cycle_times_ms: Vec<f64>,
    settings: Settings,
    noise: Noise,
    tunes: Option<DesignTunes>,
    tunes_measured: TunesMeasured,
    monitors: Vec<Monitor>,
    /// By what kicks and RF steps are off throughout the ring, of a batch fit; none without one.
    imperfections: Vec<ImperfectionResult>,
    /// Those that are larger than ordinary, for a person.
    #[serde(skip)]
    off: Option<String>,
    /// Monitors without any reading.
    silent_monitors: Vec<String>,
    /// Share of readings that are missing.
    missing: f64,
    commands: Vec<Usable>,
}

/// What was asked of the machine.
#[derive(Debug, Serialize, JsonSchema)]
struct Settings {
    /// Different ones, by read-back; several things moved at once are one only where a frame repeats them.
    count: usize,
    /// Frames of a setting: fewest, median and most.
    repeats: [usize; 3],
    /// Correctors that were powered, of how many.
    correctors: [usize; 2],
    /// Correctors that were not.
    unused: Vec<String>,
    /// Largest kick [mrad].
    largest_kick_mrad: f64,
    /// RF frequency offsets other than 0 [1].
    rf_offsets: Vec<f64>,
}

/// Noise of one reading: median over the monitors in state ok, by the scatter of repeats and by the header [mm].
#[derive(Debug, Serialize, JsonSchema)]
struct Noise {
    x: PlaneNoise,
    y: PlaneNoise,
}

#[derive(Debug, Serialize, JsonSchema)]
struct PlaneNoise {
    #[serde(skip_serializing_if = "Option::is_none")]
    of_repeats_mm: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    of_header_mm: Option<f64>,
}

/// Tunes of the ring as designed, at the recording's mean currents.
#[derive(Debug, Serialize, JsonSchema)]
struct DesignTunes {
    x: f64,
    y: f64,
}

/// What a command can do with the recording.
#[derive(Debug, Serialize, JsonSchema)]
struct Usable {
    command: &'static str,
    can: bool,
    /// How, or why not.
    what: String,
}

impl CheckResult {
    /// Of a recording of a ring.
    ///
    /// # Errors
    /// [`CommandError`] if its currents leave no stable ring.
    pub fn of(ring: &Ring, recording: &Recording) -> Result<Self, CommandError> {
        // columns that are not what the header says may leave no stable ring
        let campaign = campaign(ring, recording).map_err(|error| match Miswired::find(ring, recording) {
            Ok(Some(wiring)) => DataError::Miswired { recording: recording.name.clone(), wiring }.into(),
            _ => error,
        })?;
        Ok(Self::of_campaign(ring, &campaign))
    }

    fn of_campaign(ring: &Ring, campaign: &Campaign) -> Self {
        let Recording { name, rows, .. } = &campaign.recording;
        let (tunes, off) = (design_tunes(campaign), off_throughout(campaign));
        let readings = &campaign.readings;
        let silent = |b: &usize| readings.column(*b).iter().all(|reading| reading.is_nan());
        let names = ring.monitor_names();
        let passed = rows.windows(2).map(|pair| u64::from(pair[1].sequence - pair[0].sequence) - 1);
        Self {
            recording: name.clone(),
            machine: ring.name.clone(),
            frames: rows.len(),
            lost_frames: passed.sum(),
            seconds: rows[rows.len() - 1].time - rows[0].time,
            cycle_times_ms: cycle_times(campaign),
            settings: Settings::of(campaign),
            noise: Noise::of(campaign),
            tunes_measured: TunesMeasured::of_recording(&campaign.recording, tunes.map(|t| [t.x, t.y])),
            tunes: tunes.map(|t| DesignTunes { x: t.x, y: t.y }),
            monitors: monitors(ring, &campaign.screened.health, &campaign.screened.excluded.tallies()),
            imperfections: off.iter().map(ImperfectionResult::from).collect(),
            off: Imperfection::told(&off),
            silent_monitors: (0..names.len()).filter(silent).map(|b| names[b].clone()).collect(),
            missing: readings.iter().filter(|reading| reading.is_nan()).count() as f64 / readings.len().max(1) as f64,
            commands: vec![replay(campaign), fit(campaign), study(campaign), diagnose(campaign), device(campaign)],
        }
    }
}

/// What the design is off by; none where no batch fit ends.
fn off_throughout(campaign: &Campaign) -> Vec<Imperfection> {
    let fit = BatchFit::best(campaign, TuneUse::Readings, BaseModel::SCALES, |_| ());
    fit.map(|fit| fit.imperfections()).unwrap_or_default()
}

/// Times in the cycle along a ramp [ms]; none where the machine file has none.
fn cycle_times(campaign: &Campaign) -> Vec<f64> {
    if campaign.recording.header.ramp.is_given() { campaign.times.milliseconds() } else { Vec::new() }
}

/// Why what knows one baseline of each monitor does not take a recording.
fn several_times(campaign: &Campaign) -> Option<String> {
    (campaign.times.count() > 1).then(|| format!("needs frames at one time in the cycle; found {}", campaign.times))
}

fn design_tunes(campaign: &Campaign) -> Option<Tunes> {
    let ring = campaign.ring.with_strengths(&campaign.ring.strengths(&[], &campaign.supplies));
    Optics::of(&ring, Hold::Momentum { delta: 0.0 }).ok()?.tunes().ok()
}

impl Settings {
    fn of(campaign: &Campaign) -> Self {
        let mut repeats = vec![0; campaign.settings.count()];
        campaign.settings.repeatable.iter().flatten().for_each(|setting| repeats[*setting] += 1);
        repeats.retain(|count| *count > 0);
        repeats.sort_unstable();
        let at = |i: usize| repeats.get(i).copied().unwrap_or(0);
        let largest = |c: usize| campaign.drives.iter().map(|drive| drive.kick[c].abs()).fold(0.0, f64::max);
        let names = campaign.ring.corrector_names();
        let unused: Vec<usize> = (0..names.len()).filter(|&c| !campaign.settings.moves(c)).collect();
        let mut offsets: Vec<f64> =
            campaign.recording.rows.iter().map(|row| row.rf_offset).filter(|offset| *offset != 0.0).collect();
        offsets.sort_by(f64::total_cmp);
        offsets.dedup();
        Self {
            count: repeats.len(),
            repeats: [at(0), at(repeats.len() / 2), at(repeats.len().saturating_sub(1))],
            correctors: [names.len() - unused.len(), names.len()],
            unused: unused.into_iter().map(|c| names[c].clone()).collect(),
            largest_kick_mrad: (0..names.len()).map(largest).fold(0.0, f64::max) * 1e3,
            rf_offsets: offsets,
        }
    }
}

impl Noise {
    fn of(campaign: &Campaign) -> Self {
        let is_repeated = Settings::of(campaign).repeats[2] > 1;
        let plane = |plane: usize| {
            let own: Vec<usize> =
                (0..campaign.monitors()).filter(|&b| campaign.plane(b) == plane && campaign.is_ok(b)).collect();
            PlaneNoise {
                of_repeats_mm: median(own.iter().map(|&b| f64::from(campaign.screened.health[b].noise) * 1e3))
                    .filter(|_| is_repeated),
                of_header_mm: median(own.iter().map(|&b| campaign.recording.header.noise[b] * 1e3)),
            }
        };
        Self { x: plane(0), y: plane(1) }
    }
}

/// Whether the core takes it: its tables, the setup, and the first frame.
fn replay(campaign: &Campaign) -> Usable {
    let (ring, recording) = (&campaign.ring, &campaign.recording);
    let ready = stream::setup(ring, recording, Walk::NONE).and_then(|setup| {
        Core::try_new(ring, setup)?;
        recording.rows.iter().try_for_each(|row| stream::wire(recording, row).map(drop))
    });
    let what = match &ready {
        Err(error) => error.to_string(),
        Ok(()) => prior_only(campaign)
            .or_else(|| not_modelled(recording))
            .or_else(|| strays(ring, recording))
            .unwrap_or_else(|| "each frame to an estimate".into()),
    };
    Usable { command: "replay", can: ready.is_ok(), what }
}

fn fit(campaign: &Campaign) -> Usable {
    let params = campaign.ring.parameters.len();
    let what = prior_only(campaign).unwrap_or_else(|| format!("all frames at once, {params} vars; --method nuts too"));
    Usable { command: "fit", can: true, what }
}

/// That the result would be the prior.
fn prior_only(campaign: &Campaign) -> Option<String> {
    let lack = if campaign.has_readings() { lack(&campaign.recording) } else { Some(Lack::Readings) };
    lack.map(|lack| format!("{lack}: the result would be the prior, but for measured tunes"))
}

fn study(campaign: &Campaign) -> Usable {
    let kinds = studies::differences(campaign);
    let what = if kinds.is_empty() {
        "all frames; no corrector has the two settings that a difference takes".into()
    } else {
        format!("all frames, and differences {}", kinds.join(", "))
    };
    let why_not = not_modelled(&campaign.recording).or_else(|| several_times(campaign));
    Usable { command: "study", can: why_not.is_none(), what: why_not.unwrap_or(what) }
}

fn diagnose(campaign: &Campaign) -> Usable {
    let settings = Settings::of(campaign);
    let reading = (0..campaign.monitors()).filter(|&b| (0..campaign.frames()).any(|i| campaign.counts(i, b))).count();
    let moved = settings.correctors[0];
    let wiring = Miswired::find(&campaign.ring, &campaign.recording).ok().flatten();
    let can = reading >= LEAST && moved >= LEAST && campaign.times.count() == 1 && wiring.is_none();
    let what = if let Some(why_not) = several_times(campaign) {
        why_not
    } else if let Some(wiring) = wiring {
        wiring.to_string()
    } else if can {
        format!("{reading} monitors, {moved} correctors")
    } else {
        format!("needs {LEAST} monitors with readings and {LEAST} correctors that move; found {reading} and {moved}")
    };
    Usable { command: "diagnose", can, what }
}

/// How long a frame takes on a device's line, beside the time between frames.
fn device(campaign: &Campaign) -> Usable {
    let recording = &campaign.recording;
    let Ok(wire) = stream::wire(recording, &recording.rows[0]) else {
        return Usable { command: "device", can: false, what: "a frame cannot carry its values".into() };
    };
    let can = training::green::sizes(&campaign.ring).is_ok_and(|sizes| largest::SIZES.hold(&sizes));
    let milliseconds = wire.len() as f64 * LINE.1 / LINE.0 * 1e3;
    let what = format!(
        "{} bytes a frame, {milliseconds:.1} ms at {} baud; make firmware builds the image, and says whether it fits",
        wire.len(),
        LINE.0
    );
    Usable { command: "device", can, what }
}

/// Columns of a fact's name.
const NAME: usize = 20;

impl fmt::Display for CheckResult {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{} of {}\n", self.recording, self.machine)?;
        for (name, value) in self.facts() {
            let below = format!("\n{:NAME$}", "");
            writeln!(f, "{name:<NAME$}{}", lines(&value, 80 - NAME).join(&below))?;
        }
        writeln!(f)?;
        let mut commands = table(["command", "can", "what"]);
        for one in &self.commands {
            commands.add_row([one.command, if one.can { "yes" } else { "no" }, &one.what]);
        }
        commands.column_iter_mut().for_each(|column| column.set_cell_alignment(CellAlignment::Left));
        write!(f, "{commands}")
    }
}

impl CheckResult {
    fn facts(&self) -> Vec<(&'static str, String)> {
        let Self { settings, .. } = self;
        let [fewest, median, most] = settings.repeats;
        let noise = |plane: &PlaneNoise| match (plane.of_repeats_mm, plane.of_header_mm) {
            (Some(found), Some(stated)) => format!("{found:.3} mm, the header says {stated:.3} mm"),
            (None, Some(stated)) => format!("no repeats, the header says {stated:.3} mm"),
            _ => "no monitor in state ok".into(),
        };
        let lost =
            if self.lost_frames == 0 { String::new() } else { format!(", {} lost between them", self.lost_frames) };
        let tunes = self.tunes.as_ref().map_or_else(|| "no stable ring".into(), |t| format!("{:.4} {:.4}", t.x, t.y));
        let offsets = match settings.rf_offsets.as_slice() {
            [] => String::new(),
            offsets => {
                format!(", RF offsets {}", offsets.iter().map(|o| format!("{o:+.1e}")).collect::<Vec<_>>().join(" "))
            }
        };
        let times: Vec<String> = self.cycle_times_ms.iter().map(f64::to_string).collect();
        let times = if times.is_empty() { String::new() } else { format!(", at {} ms in the cycle", times.join(", ")) };
        let facts = vec![
            ("frames", format!("{} in {:.0} s{lost}{times}", self.frames, self.seconds)),
            ("settings", format!("{}, with {fewest} to {most} frames each (median {median})", settings.count)),
            ("correctors", format!("{} of {} powered{offsets}", settings.correctors[0], settings.correctors[1])),
            ("largest kick", format!("{:.3} mrad", settings.largest_kick_mrad)),
            ("noise x, by repeats", noise(&self.noise.x)),
            ("noise y, by repeats", noise(&self.noise.y)),
            ("tunes as designed", format!("{tunes}, {}", self.tunes_measured)),
            ("monitors", faults(&self.monitors)),
            ("readings missing", format!("{:.1} %", 100.0 * self.missing)),
        ];
        let lists = [("without a kick", &settings.unused), ("without a reading", &self.silent_monitors)];
        let lists = lists.into_iter().filter(|(_, names)| !names.is_empty());
        let off = self.off.iter().map(|off| ("off throughout", off.clone()));
        facts.into_iter().chain(off).chain(lists.map(|(name, names)| (name, names.join(", ")))).collect()
    }
}
