//! Readings that the screening put aside where the level of the noise changes ([`super::levels`]): they are what the noise makes, and count again.
//!
//! The screening judges by one noise for the whole recording. In a part with more it puts the largest readings aside, which makes the others' noise too
//! small, calls the monitors that have many of them faulty, and may follow some that agree by chance instead of good ones of the same setting elsewhere.
//! Readings within some standard deviations of the noise in their frame are taken back, and with them the monitors of which nearly none are left aside. Three kinds of readings stay out: those of a monitor that repeats its
//! value, those of a frame without a beam, and those of a frame with another orbit.

use estimator::MonitorState;
use inference::{Campaign, Exclusions, Screened};

use super::noise::{Noise, Source};
use twin::median;

/// Standard deviations of the noise within which a reading is taken back, where the level is larger and where it is ordinary: there a small jump is
/// further away.
const WITHIN: [f64; 2] = [5.0, 3.0];
/// Share of a frame's readings that may be further away; a frame with more has another orbit.
const FEW: f64 = 0.2;
/// Share of a monitor's readings that may be left aside: of one that the screening calls jumping one in a hundred jumps at least, and some of these within
/// larger noise.
pub const JUMPS: f64 = 1.0 / 300.0;

/// What counts with the noise that was learnt.
pub fn readmitted(source: &Source, noise: &Noise) -> Screened {
    let Source { campaign, residual, .. } = *source;
    let monitors = campaign.monitors();
    let middles: Vec<f64> = (0..monitors).map(|b| middle(source, b)).collect();
    let is_near = |frame: usize, b: usize| {
        let level = noise.levels.at(frame);
        let sigma = ordinary_noise(campaign, noise, b) * level;
        (residual[(frame, b)] - middles[b]).abs() < WITHIN[usize::from(level == 1.0)] * sigma
    };
    let is_of_orbit = |frame: &usize| {
        let read: Vec<usize> = (0..monitors).filter(|&b| !(residual[(*frame, b)] - middles[b]).is_nan()).collect();
        let far = read.iter().filter(|&&b| !is_near(*frame, b)).count();
        !campaign.recording.rows[*frame].is_without_beam() && far as f64 <= FEW * read.len() as f64
    };
    let frames: Vec<usize> = (0..campaign.frames()).filter(is_of_orbit).collect();
    let mut again = campaign.screened.clone();
    for (b, health) in again.health.iter_mut().enumerate().filter(|(_, health)| health.state != MonitorState::Dead) {
        let is_back =
            |frame: &&usize| !campaign.counts(**frame, b) && is_near(**frame, b) && !repeats(campaign, **frame, b);
        for &frame in frames.iter().filter(is_back) {
            again.excluded.lift(frame, b);
            health.rejected = health.rejected.saturating_sub(1);
        }
    }
    for b in 0..monitors {
        if again.health[b].state == MonitorState::Jumps && left_aside(&again.excluded, b) <= JUMPS {
            again.health[b].weighted_as = again.health[b].noise;
            again.health[b].state = MonitorState::Ok;
        }
    }
    again
}

/// Share of a monitor's readings that are left aside in frames in which few others are.
pub fn left_aside(excluded: &Exclusions, b: usize) -> f64 {
    let (frames, monitors) = excluded.size();
    let aside = |frame: usize| (0..monitors).filter(|&b| excluded.is_aside(frame, b)).count();
    let frames: Vec<usize> = (0..frames).filter(|&frame| aside(frame) as f64 <= FEW * monitors as f64).collect();
    frames.iter().filter(|&&frame| excluded.is_aside(frame, b)).count() as f64 / frames.len().max(1) as f64
}

/// Noise of a monitor where the level is ordinary [m]: as learnt from its repeats, or the header's at the scale of all.
fn ordinary_noise(campaign: &Campaign, noise: &Noise, b: usize) -> f64 {
    if campaign.is_ok(b) { noise.own[b] } else { campaign.recording.header.noise[b] * noise.common_scale.value }
}

/// Median of what a monitor's readings that count leave, not a number without any.
fn middle(source: &Source, b: usize) -> f64 {
    let frames = (0..source.campaign.frames()).filter(|&frame| source.campaign.counts(frame, b));
    median(frames.map(|frame| source.residual[(frame, b)])).unwrap_or(f64::NAN)
}

/// True for a reading that is the same as the one before or after.
fn repeats(campaign: &Campaign, frame: usize, b: usize) -> bool {
    let readings = campaign.readings.column(b);
    let is_same = |other: usize| readings.get(other).is_some_and(|reading| *reading == readings[frame]);
    frame.checked_sub(1).is_some_and(is_same) || is_same(frame + 1)
}
