//! Orbit feedback: corrector setpoints from the orbit, the response as it is estimated, and what is not known of it.
//!
//! With `r` the orbit less the one that is wanted, `k` the kicks at the setpoints and `R(theta)` the estimated response, the
//! setpoints move by the kicks `d` that minimise
//!
//! `E |r + R(theta) d|^2_W + |d|^2/step^2 + |k + d|^2/total^2`,
//!
//! the mean taken over the posterior of theta: `|r + R d|^2_W + d^T Q d` with `Q_cd = sum over b of W_b cov(R_bc, R_bd)`, so that
//! kicks whose effect is not known are left alone. `W` has `1/noise^2` of each monitor, less the dispersion: an orbit error of
//! its shape is one of momentum, and no corrector is to make up for it. The minimum is `d = -A^-1 (R^T W r + k/total^2)` with
//! `A = R^T W R + Q + 1/step^2 + 1/total^2`; `A^-1` is made between frames ([`Steer::prepare`]), and a frame costs three products
//! of a matrix and a vector ([`Steer::steer`]).
//!
//! `r` is filtered, each monitor for itself: what the correctors have done since the last frame is added by the response, and the
//! share `p/(p + noise^2)` of what is then left of the reading, `p` being the variance of the orbit as it is known: it grows by
//! `walk^2` in a second, and each reading takes its share off. So a new orbit, at the beginning or once the baselines have moved,
//! begins as the mean of its frames, and a monitor that does not report keeps its last orbit, moved by the correctors, and is
//! believed the more when it comes back. Where the readings of some frames are off by more than `p` and the noise explain, the
//! orbit has moved (`pace.rs`), and `p` grows by what they are off.
//!
//! Source: S. Boyd and L. Vandenberghe, Convex Optimization (2004), sec. 6.4.1, stochastic robust approximation; K. J. Astrom and
//! B. Wittenmark, Adaptive Control (1995), ch. 9, cautious control.

mod gain;
mod hold;
mod pace;
mod supplies;
#[cfg(test)]
mod tests;

use serde::{Deserialize, Serialize};

use crate::drive::{Drive, Each};
use crate::estimate::{Health, MonitorState};
use crate::judged::Judged;
use crate::linear::dot;
use crate::ramp::is_same_time;
use crate::surrogate::Steerable;
use crate::triangle::Triangle;
use crate::wire::{CurrentCode, Frame, PositionCode};

use gain::Gain;
pub use hold::Hold;
use hold::Watch;
use pace::Pace;
use supplies::Supplies;

/// What is wanted of the orbit, and what the correctors may do; read only.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Feedback<const B: usize, const C: usize> {
    /// Wanted reading of each monitor [m].
    pub orbit: Each<B>,
    /// How far the orbit walks by itself at a monitor, standard deviation per square root of a second [m]: the slower, the longer
    /// its readings are averaged.
    pub walk: f32,
    /// Kick of one corrector in one frame that costs as much as an orbit of one standard deviation at one monitor [rad].
    pub step_kick: f32,
    /// The same of its whole kick: what no monitor sees decays, and correctors stay near 0 [rad].
    pub total_kick: f32,
    /// Largest current of each corrector [A]; one with 0 is moved by others, and not by the feedback.
    pub limit: Each<C>,
    /// Largest change of a setpoint in one frame [A].
    pub rate: f32,
    /// By how much each corrector is moved one way or the other, anew in each frame, while the model is in doubt [A]: see
    /// [`Hold::is_doubt`].
    pub probe: f32,
    /// Read-backs this close to their setpoints follow them [A].
    pub close: f32,
    /// Frames further apart than this do not belong together [us].
    pub patience_us: u64,
}

impl<const B: usize, const C: usize> Feedback<B, C> {
    /// True if every number is one, and every size positive.
    pub fn is_sound(&self) -> bool {
        let sizes = [self.walk, self.step_kick, self.total_kick, self.rate, self.close];
        self.orbit.is_finite()
            && sizes.iter().all(|v| v.is_finite() && *v > 0.0)
            && self.probe.is_finite()
            && self.probe >= 0.0
            && self.limit.is_finite()
            && (0..C).all(|c| self.limit.of(c) >= 0.0)
            && (0..C).any(|c| self.uses(c))
    }

    /// True for a corrector that the feedback moves.
    pub fn uses(&self, corrector: usize) -> bool {
        self.limit.of(corrector) > 0.0
    }

    /// Largest current that a correction asks of a corrector: a probe has room beyond it [A].
    fn edge(&self, corrector: usize) -> f32 {
        (self.limit.of(corrector) - self.probe).max(0.0)
    }
}

/// The ring as steering sees it.
#[derive(Debug)]
pub struct Response<'a, G: Steerable<B, C, F, N>, const B: usize, const C: usize, const F: usize, const N: usize> {
    /// Its tables.
    pub surrogate: &'a G,
    /// At which vars.
    pub at: &'a G::Linearised,
    /// Kick of each corrector at the reference momentum [rad/A].
    pub kick_per_ampere: &'a Each<C>,
    /// Momentum at the frame's time in the cycle, over the reference.
    pub momentum: f32,
}

/// What is to be said of a frame's correction.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[must_use]
pub struct Steered {
    /// Why the setpoints stay as they were; none if they were moved.
    pub hold: Option<Hold>,
    /// Correctors that do not follow their setpoints, and are left out.
    pub left_out: u16,
    /// Correctors at their limit.
    pub limited: u16,
}

/// The state of a feedback on the orbit at one time in the cycle; each time takes one of its own. `B` monitors, `C` correctors, `CX` and `CY` of them horizontal and vertical; `TX` and `TY` entries
/// make triangles of these.
#[derive(Debug, Clone)]
pub struct Steer<const B: usize, const C: usize, const CX: usize, const CY: usize, const TX: usize, const TY: usize> {
    /// Time of the last frame [us].
    clock: Option<u64>,
    /// Time in the cycle of the orbit that is steered [us].
    cycle_time: u32,
    /// Filtered orbit at the last read-backs, less the wanted one [m].
    residual: [f32; B],
    /// Its variance [m^2].
    variance: [f32; B],
    /// `1/noise^2` of each monitor [1/m^2]; 0 of one that is dead.
    weight: [f32; B],
    /// `W D/sqrt(D^T W D)` of the dispersion `D` [1/m].
    momentum: [f32; B],
    supplies: Supplies<C>,
    /// Pattern of the probe in the setpoints; 0 for none.
    pattern: u32,
    x: Gain<CX, TX>,
    y: Gain<CY, TY>,
    /// Frames since the gains of x were due.
    turn: u8,
    watch: Watch,
    pace: Pace,
    steered: Steered,
}

/// Frames after which gains are made anew, for the estimate moves on.
const TURN: u8 = 16;

/// Variance of an orbit that nothing is known of [m^2]: 0.1 m, in a beam pipe.
const UNKNOWN: f32 = 1e-2;

/// RF offset whose orbit stands for the dispersion: small enough to be of first order.
const RF_OFFSET: f32 = 1e-6;

impl<'a, G: Steerable<B, C, F, N>, const B: usize, const C: usize, const F: usize, const N: usize>
    Response<'a, G, B, C, F, N>
{
    /// The orbit that kicks make [m].
    #[inline(never)]
    fn orbit(&self, kick: [f32; C]) -> [f32; B] {
        self.orbit_of(&Drive { kick, strength: [0.0; F], rf_offset: 0.0 })
    }

    /// The shape of an orbit that is off momentum [m].
    fn dispersion(&self) -> [f32; B] {
        self.orbit_of(&Drive { kick: [0.0; C], strength: [0.0; F], rf_offset: RF_OFFSET })
    }

    fn orbit_of(&self, drive: &Drive<C, F>) -> [f32; B] {
        let mut orbit = [0.0; B];
        self.surrogate.orbit(self.at, drive, &mut orbit);
        orbit
    }

    /// `R^T orbit` [m^2/rad].
    #[inline(never)]
    fn pull(&self, orbit: &[f32; B]) -> [f32; C] {
        let mut pull = [0.0; C];
        self.surrogate.pull(self.at, orbit, &mut pull);
        pull
    }

    /// Kick of a corrector [rad/A].
    fn kick(&self, c: usize) -> f32 {
        self.kick_per_ampere.of(c) / self.momentum
    }

    /// Currents as kicks [rad].
    #[inline(never)]
    fn kicks(&self, mut current: [f32; C]) -> [f32; C] {
        current.iter_mut().enumerate().for_each(|(c, current)| *current *= self.kick(c));
        current
    }
}

impl<const B: usize, const C: usize, const CX: usize, const CY: usize, const TX: usize, const TY: usize>
    Steer<B, C, CX, CY, TX, TY>
{
    const FITS: () = assert!(C == CX + CY, "planes add up");

    /// Memory for one, all zero: it begins with the first frame.
    pub const BLANK: Self = Self {
        clock: None,
        cycle_time: 0,
        residual: [0.0; B],
        variance: [0.0; B],
        weight: [0.0; B],
        momentum: [0.0; B],
        supplies: Supplies::BLANK,
        pattern: 0,
        x: Gain::BLANK,
        y: Gain::BLANK,
        turn: 0,
        watch: Watch::BLANK,
        pace: Pace::STEADY,
        steered: Steered { hold: None, left_out: 0, limited: 0 },
    };

    /// The currents that the correctors are to have.
    pub fn setpoints(&self) -> &[CurrentCode; C] {
        self.supplies.setpoints()
    }

    /// What is to be said of the last frame's correction.
    pub fn steered(&self) -> Steered {
        self.steered
    }

    /// False for a corrector that does not follow its setpoint, and is left out until it does.
    pub fn follows(&self, corrector: usize) -> bool {
        self.supplies.follows(corrector)
    }

    /// Take a frame in that was judged, and move the setpoints, or say why not.
    #[inline(never)]
    pub fn steer<G: Steerable<B, C, F, N>, const F: usize, const N: usize, const W: usize>(
        &mut self,
        feedback: &Feedback<B, C>,
        response: &Response<'_, G, B, C, F, N>,
        judged: &Judged<B, C, F, W>,
    ) -> Steered {
        let () = Self::FITS;
        self.weigh_monitors(&judged.health);
        let gap = self.gap(feedback, &judged.frame);
        match gap {
            Some(seconds) => self.observe(feedback, response, judged, seconds),
            None => self.begin(feedback, judged),
        }
        let is_stale = gap.is_none();
        let is_ready = self.x.is_ready() && self.y.is_ready();
        let hold = self.watch.judge(is_stale, is_ready, judged, response.surrogate.layout().monitors());
        self.supplies.probe(-feedback.probe, core::mem::take(&mut self.pattern), &feedback.limit);
        let limited = if hold.is_none() { self.correct(feedback, response) } else { 0 };
        if hold.is_some_and(Hold::is_doubt) {
            self.pattern = (judged.frame.time_us as u32).max(1);
            self.supplies.probe(feedback.probe, self.pattern, &feedback.limit);
        }
        self.steered = Steered { hold, left_out: self.supplies.left_out(), limited };
        self.steered
    }

    /// Make the gains of one plane anew if that is due; true if it was done. To be called after each frame.
    ///
    /// `covariance` gives one row of that of the params.
    #[inline(never)]
    pub fn prepare<G: Steerable<B, C, F, N>, const F: usize, const N: usize>(
        &mut self,
        feedback: &Feedback<B, C>,
        response: &Response<'_, G, B, C, F, N>,
        covariance: impl Fn(usize) -> [f32; N],
    ) -> bool {
        if self.clock.is_none() {
            return false;
        }
        let turn = self.turn;
        self.turn = (turn + 1) % TURN;
        self.weigh_momentum(&response.dispersion());
        let diagonal = 1.0 / (feedback.step_kick * feedback.step_kick) + stiffness(feedback);
        match turn {
            0 => self.x.invert(self.matrix(response, 0, diagonal, covariance, |c| self.counts(feedback, c))),
            1 => self.y.invert(self.matrix(response, CX, diagonal, covariance, |c| self.counts(feedback, c))),
            _ => return false,
        }
        true
    }

    /// True for a corrector that the feedback moves, and that follows.
    fn counts(&self, feedback: &Feedback<B, C>, corrector: usize) -> bool {
        feedback.uses(corrector) && self.supplies.follows(corrector)
    }

    /// Time since the last frame [s]; none if there was none that belongs to this one: too early, or of another time in the cycle.
    fn gap<const F: usize, const W: usize>(
        &mut self,
        feedback: &Feedback<B, C>,
        frame: &Frame<B, C, F, W>,
    ) -> Option<f32> {
        let gap = frame.time_us.checked_sub(self.clock.replace(frame.time_us)?)?;
        let goes_on = gap <= feedback.patience_us && is_same_time(self.cycle_time, frame.cycle_time_us);
        goes_on.then_some(1e-6 * gap as f32)
    }

    /// Take over from whoever steered so far: setpoints are the read-backs, the orbit is that of this frame.
    fn begin<const F: usize, const W: usize>(&mut self, feedback: &Feedback<B, C>, judged: &Judged<B, C, F, W>) {
        let frame = &judged.frame;
        self.cycle_time = frame.cycle_time_us;
        if self.supplies.left_out() > 0 {
            self.forget_gains();
        }
        self.supplies.take_over(&frame.corrector);
        self.pattern = 0;
        (self.residual, self.variance, self.pace) = ([0.0; B], [UNKNOWN; B], Pace::STEADY);
        self.believe(feedback, 0.0, &frame.reading, |b| judged.screened.accepted.has(b));
    }

    /// Other correctors count from now on: gains that were made without one would give it ten times the kick that it should have.
    fn forget_gains(&mut self) {
        self.x.forget();
        self.y.forget();
        self.turn = 0;
    }

    /// Move the filtered orbit by what the correctors have done, then towards the readings.
    #[inline(never)]
    fn observe<G: Steerable<B, C, F, N>, const F: usize, const N: usize, const W: usize>(
        &mut self,
        feedback: &Feedback<B, C>,
        response: &Response<'_, G, B, C, F, N>,
        judged: &Judged<B, C, F, W>,
        seconds: f32,
    ) {
        let frame = &judged.frame;
        let (done, changed) = self.supplies.hear(&frame.corrector, feedback.close, |c| feedback.uses(c));
        if changed {
            self.forget_gains();
        } else if judged.linearised && self.turn > 1 {
            self.turn = 0;
        }
        let moved = response.orbit(response.kicks(done));
        self.residual.iter_mut().zip(moved).for_each(|(residual, moved)| *residual += moved);
        if judged.remarks.baselines_moved {
            self.variance = [UNKNOWN; B];
        }
        self.believe(feedback, seconds, &frame.reading, |b| judged.screened.accepted.has(b));
    }

    /// Move the filtered orbit towards the readings that count, so many seconds after the last ones.
    fn believe(
        &mut self,
        feedback: &Feedback<B, C>,
        seconds: f32,
        reading: &[PositionCode; B],
        counts: impl Fn(usize) -> bool,
    ) {
        let walked = feedback.walk * feedback.walk * seconds;
        self.variance.iter_mut().for_each(|variance| *variance = (*variance + walked).min(UNKNOWN));
        let mut innovation = [0.0; B];
        let each = innovation.iter_mut().zip(reading).zip(&self.residual).enumerate();
        for (b, ((to, reading), residual)) in each.filter(|(b, _)| counts(*b)) {
            *to = reading.value() - feedback.orbit.of(b) - residual;
        }
        let moved = self.pace.hear((0..B).filter(|b| counts(*b)).filter_map(|b| {
            let (innovation, weight) = (innovation.get(b)?, self.weight.get(b)?);
            Some(innovation * innovation * weight / (1.0 + self.variance.get(b)? * weight))
        }));
        let each =
            self.residual.iter_mut().zip(&mut self.variance).zip(innovation.iter().zip(&self.weight)).enumerate();
        for (_, ((residual, variance), (innovation, weight))) in each.filter(|(b, _)| counts(*b)) {
            let known = *variance * weight + moved;
            *residual += known / (1.0 + known) * innovation;
            *variance = if *weight > 0.0 { known / (1.0 + known) / weight } else { *variance };
        }
    }

    fn weigh_monitors(&mut self, health: &[Health; B]) {
        for (weight, health) in self.weight.iter_mut().zip(health) {
            let is_of_use = health.state != MonitorState::Dead && health.weighted_as > 0.0;
            *weight = if is_of_use { 1.0 / (health.weighted_as * health.weighted_as) } else { 0.0 };
        }
    }

    fn weigh_momentum(&mut self, dispersion: &[f32; B]) {
        self.momentum = *dispersion;
        self.momentum.iter_mut().zip(&self.weight).for_each(|(m, weight)| *m *= weight);
        let square = dot(&self.momentum, dispersion);
        let scale = if square > 0.0 { 1.0 / libm::sqrtf(square) } else { 0.0 };
        self.momentum.iter_mut().for_each(|m| *m *= scale);
    }

    /// `W r`, less what is of momentum.
    #[inline(never)]
    fn weighted(&self, orbit: &[f32; B]) -> [f32; B] {
        let off_momentum = dot(&self.momentum, orbit);
        let mut weighted = *orbit;
        for ((to, weight), momentum) in weighted.iter_mut().zip(&self.weight).zip(&self.momentum) {
            *to = *to * weight - off_momentum * momentum;
        }
        weighted
    }

    /// `A` of the plane whose correctors begin at `first`; those that do not count have a diagonal only.
    #[inline(never)]
    fn matrix<G: Steerable<B, C, F, N>, const F: usize, const N: usize, const CP: usize, const TP: usize>(
        &self,
        response: &Response<'_, G, B, C, F, N>,
        first: usize,
        diagonal: f32,
        covariance: impl Fn(usize) -> [f32; N],
        counts: impl Fn(usize) -> bool,
    ) -> Triangle<CP, TP, f64> {
        let mut matrix = Triangle::ZERO;
        matrix.fill_diagonal(f64::from(diagonal));
        for (i, row) in matrix.rows_mut().enumerate() {
            let mut kick = [0.0; C];
            kick.get_mut(first + i).into_iter().for_each(|kick| *kick = 1.0);
            let pull = response.pull(&self.weighted(&response.orbit(kick)));
            add_single(row, 1.0, pull.get(first..).unwrap_or_default());
        }
        let plane = usize::from(first > 0);
        response.surrogate.response_covariance(response.at, plane, &self.weight, covariance, |here, there| {
            matrix.rows_mut().zip(here).for_each(|(row, h)| add_single(row, *h, there));
        });
        for (i, row) in matrix.rows_mut().enumerate() {
            for (j, to) in row.iter_mut().enumerate().filter(|(j, _)| !(counts(first + i) && counts(first + *j))) {
                *to = if i == j { f64::from(diagonal) } else { 0.0 };
            }
        }
        matrix
    }

    /// Move the setpoints; returns how many correctors are at their limit.
    #[inline(never)]
    fn correct<G: Steerable<B, C, F, N>, const F: usize, const N: usize>(
        &mut self,
        feedback: &Feedback<B, C>,
        response: &Response<'_, G, B, C, F, N>,
    ) -> u16 {
        // setpoints that are still on their way will move the orbit
        let mut orbit = response.orbit(response.kicks(self.supplies.under_way(feedback.close)));
        orbit.iter_mut().zip(&self.residual).for_each(|(orbit, residual)| *orbit += residual);
        let mut pull = response.pull(&self.weighted(&orbit));
        let (stiffness, total) =
            (stiffness(feedback), response.kicks(self.supplies.setpoints().map(CurrentCode::value)));
        for (c, (pull, total)) in pull.iter_mut().zip(total).enumerate() {
            *pull = if self.counts(feedback, c) { *pull + stiffness * total } else { 0.0 };
        }
        let setpoints = self.supplies.setpoints();
        let room = |c: usize| {
            let (limit, rate, kick) = (feedback.edge(c), feedback.rate, response.kick(c));
            let current = setpoints.get(c).copied().unwrap_or_default().value();
            if !feedback.uses(c) {
                return [0.0; 2];
            }
            // one that is beyond its limit comes back at its rate
            [-limit - current, limit - current].map(|to| to.min(rate).max(-rate) * kick)
        };
        let (pull_x, pull_y) = pull.split_at(CX.min(C));
        let mut step = [0.0; C];
        let (step_x, step_y) = step.split_at_mut(CX.min(C));
        self.x.step(pull_x, &room, 0, step_x);
        self.y.step(pull_y, &room, CX, step_y);
        step.iter_mut().enumerate().for_each(|(c, step)| *step /= response.kick(c));
        self.supplies.change(&step, |c| feedback.edge(c))
    }
}

/// `to += factor * from`, each product in single precision.
#[inline(never)]
fn add_single(to: &mut [f64], factor: f32, from: &[f32]) {
    to.iter_mut().zip(from).for_each(|(to, from)| *to += f64::from(factor * from));
}

/// `1/total^2` [1/rad^2].
fn stiffness<const B: usize, const C: usize>(feedback: &Feedback<B, C>) -> f32 {
    1.0 / (feedback.total_kick * feedback.total_kick)
}
