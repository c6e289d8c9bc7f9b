//! Monitors that wander, as the search finds them: a walk too small to be seen in repeats.

use twin::Measured;

use super::Found;
use crate::alternatives::{Alternative, Cause};
use crate::data::Data;
use crate::fit::{FitError, Fitted};
use crate::half_normal::HalfNormal;
use crate::location::Location;
use crate::slow_noise::OWN;

/// Walks that are tried, and monitors of a recording that may wander by themselves: with more it is something that they share.
const WALKS: usize = 12;
const WANDERERS: usize = 4;
/// `ln` odds of 95 %, by which another change of one monitor has to be more likely than its walk, which is no physics.
const DOUBT: f64 = 2.94;

/// The recordings with monitors that wander, all or one, where that is more likely than none and than any other cause. A walk too small to be seen
/// in repeats shows in what a fit leaves, since it then has all settings to compare.
pub fn wandering(found: &Found) -> Result<Option<Data>, FitError> {
    let Found { data, best, next, .. } = found;
    let leader = next.alternatives.first().filter(|_| next.is_suspicious() && !best.is_poor());
    let Some(Alternative { cause: Cause::Unmodelled(leading), probability, .. }) = leader else { return Ok(None) };
    let noise = &data.campaign(leading.campaign).noise;
    let is_known = |b: usize| noise.wandering.iter().any(|(at, _)| *at == b);
    let steady = data.campaigns().all(|own| own.noise.slow.walk.value == 0.0);
    // the monitor that the cause is about, or all, where nothing is known of their walk yet and repeats say what is ordinary
    let one = match leading.at {
        _ if noise.ordinary_walk <= 0.0 => return Ok(None),
        Location::Time if steady => None,
        Location::MonitorInTime(b) if !is_known(b) && noise.wandering.len() < WANDERERS => Some((leading.campaign, b)),
        _ => return Ok(None),
    };
    let log_likelihood = |value: f64| {
        let wandering = best.data(data).wandering(one, Measured { value, sigma: 0.0 });
        let fitted = Fitted::from_guess(&wandering, &best.hypothesis, &best.u);
        fitted.map_or(f64::NEG_INFINITY, |fitted| fitted.log_evidence)
    };
    let posterior = HalfNormal::from_log_likelihood(log_likelihood, noise.ordinary_walk, WALKS);
    // of one monitor, prior odds against none, and those by which another cause has to be more likely
    let (prior, doubt) = if one.is_some() { (OWN.ln(), DOUBT) } else { (0.0, 0.0) };
    let of_walk = posterior.log_evidence - best.log_evidence + prior;
    let of_leader = (probability / next.nothing.max(f64::MIN_POSITIVE)).ln();
    let walk = Measured { value: posterior.mean, sigma: posterior.sigma() };
    Ok((of_walk > (of_leader - doubt).max(0.0)).then(|| data.wandering(one, walk)))
}
