//! Readings that the screening put aside where the noise of all monitors is larger: they are what that noise makes, and count again.
//!
//! The screening judges by the noise of the whole recording. In a stretch of larger noise ([`super::levels`]) it puts the largest readings aside, which makes
//! the rest look quieter than they are, and calls the monitors that have many of them faulty. Readings within five standard deviations of the stretch's
//! noise are taken back, and with them the monitors that jump in such stretches alone. A frame without a beam, or with another orbit, stays out.

use estimator::MonitorState;
use inference::Campaign;

use super::noise::{Noise, Source};

/// Standard deviations of the noise of its frame within which a reading is taken back.
const WITHIN: f64 = 5.0;
/// Share of a frame's readings that may be further away; a frame with more has another orbit.
const FEW: f64 = 0.2;
/// Share of a monitor's readings elsewhere that may be put aside: a sound one has as many by chance.
const BY_CHANCE: f64 = 0.01;

/// The campaign with these readings, if there are any.
pub fn readmitted(source: &Source, noise: &Noise) -> Option<Campaign> {
    let Source { campaign, residual, .. } = *source;
    let monitors = campaign.monitors();
    let level = |frame: usize| noise.levels.at(frame);
    let loud: Vec<usize> = (0..campaign.frames()).filter(|&frame| level(frame) > 1.0).collect();
    let middle: Vec<f64> = (0..monitors).map(|b| middle(source, b)).collect();
    let is_near = |frame: usize, b: usize| {
        let sigma = campaign.recording.header.noise[b] * noise.common_scale.value * level(frame);
        (residual[(frame, b)] - middle[b]).abs() < WITHIN * sigma
    };
    let is_read = |frame: usize, b: usize| !residual[(frame, b)].is_nan() && !middle[b].is_nan();
    let mut again = campaign.clone();
    let mut is_changed = false;
    for &frame in loud.iter().filter(|&&frame| !campaign.recording.rows[frame].is_without_beam()) {
        let read: Vec<usize> = (0..monitors).filter(|&b| is_read(frame, b)).collect();
        let far = read.iter().filter(|&&b| !is_near(frame, b)).count();
        if far as f64 > FEW * read.len() as f64 {
            continue;
        }
        for b in read.into_iter().filter(|&b| is_near(frame, b) && !campaign.counts(frame, b)) {
            again.screened.accepted[(frame, b)] = true;
            is_changed = true;
        }
    }
    for (b, health) in again.screened.health.iter_mut().enumerate() {
        let elsewhere = || (0..campaign.frames()).filter(|&frame| level(frame) == 1.0 && is_read(frame, b));
        let aside = elsewhere().filter(|&frame| !campaign.counts(frame, b)).count();
        if health.state == MonitorState::Jumps && aside as f64 <= BY_CHANCE * elsewhere().count() as f64 {
            (health.state, health.weighted_as) = (MonitorState::Ok, health.noise);
        }
    }
    is_changed.then_some(again)
}

/// Median of what a monitor's readings that count leave, not a number without any.
fn middle(source: &Source, b: usize) -> f64 {
    let frames = (0..source.campaign.frames()).filter(|&frame| source.campaign.counts(frame, b));
    let mut values: Vec<f64> = frames.map(|frame| source.residual[(frame, b)]).collect();
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied().unwrap_or(f64::NAN)
}
