//! Held-out readings: how well a hypothesis predicts what it was not fitted to.
//!
//! Whole pools of frames are left out in blocks, all monitors and tunes of each: every pool in turn, which the other pools of its
//! corrector and all others predict, or all pools of a corrector. With everything linear about the fit to all pools, `T` the whitening,
//! `J` the derivative and `N = 1 + J^T J`, the precision of all readings, the unknowns being integrated out, is `K = T^T (1 - J N^-1 J^T) T`,
//! and the density of a block F given all others is exactly that of
//!
//! `e = K_FF^-1 (T^T r)_F`, the readings less those that the others predict, normal with the covariance `K_FF^-1`,
//!
//! `r` being the whitened residuals of the fit: no fit needs to be repeated, and readings that share a momentum's jitter, a crate's noise or
//! a baseline are predicted together. The density is split into those of single readings, each given those after it in the block.
//!
//! The sum of the log densities is the expected log predictive density (elpd); a difference of two hypotheses has the
//! standard error of its mean over these: given the model they are independent, also within a frame, and an effect of one corrector
//! has few pools and many readings.
//!
//! Source: A. Vehtari, A. Gelman and J. Gabry, Stat. Comput. 27 (2017) 1413, eq. 4 and 23; S. Sundararajan and S. S. Keerthi, Neural
//! Comput. 13 (2001) 1103, eq. 10, what is left out of a Gaussian process.

use estimator::MonitorState;
use evidence::{Factor, gram};
use nalgebra::{DMatrix, DVector};

use super::choice::Choice;
use super::data::Data;
use super::fit::{FitError, Fitted};
use super::hypothesis::Hypothesis;
use super::linearisation::about_itself;
use super::scan::SignatureScore;
use super::term::Term;

/// Pools that are left out together, counted through all recordings.
pub type Block = Vec<usize>;

/// Number of standard errors by which the prediction of held-out readings has to improve.
pub const VALIDATED: f64 = 2.0;
/// The same where chance is excluded: a step of the RF is in few runs, and leaving one out takes much of what shows it.
pub const SUPPORTED: f64 = 1.0;
/// Share of the recordings drawn with nothing missing in which the search finds as much, up to which chance is excluded.
pub const CHANCE: f64 = 0.01;

/// Every pool by itself.
pub fn by_pool(data: &Data) -> Vec<Block> {
    (0..pools_of(data)).map(|pool| vec![pool]).collect()
}

/// All pools in which a corrector is powered most, of each that is.
pub fn by_corrector(data: &Data) -> Vec<Block> {
    let mut blocks = vec![Block::new(); data.drives.kick.ncols()];
    for (own, pools) in data.campaigns().zip(data.pools_of_each()) {
        for pool in 0..own.pools.count {
            if let Some((corrector, _)) = own.settings.kick(pool) {
                blocks[corrector].push(pools.start + pool);
            }
        }
    }
    blocks.retain(|block| !block.is_empty());
    blocks
}

/// Pools of all recordings.
fn pools_of(data: &Data) -> usize {
    data.campaigns().map(|own| own.pools.count).sum()
}

/// The held-out predictions of a hypothesis, scored.
#[derive(Debug, Clone)]
pub struct Score {
    /// Log density of each reading, block by block.
    pub log_density: Vec<f64>,
    /// Rms of measured minus predicted means of pools, monitors in state ok [m].
    pub rms: f64,
    /// Fraction of readings within one and two standard deviations of their density.
    pub inside: [f64; 2],
}

impl Score {
    /// Score a hypothesis that has been fitted to all pools.
    ///
    /// # Errors
    /// [`FitError::Degenerate`].
    pub fn from_blocks(data: &Data, fitted: &Fitted, blocks: &[Block]) -> Result<Self, FitError> {
        let data = fitted.data(data);
        let precision = Precision::from_fit(data, fitted);
        let (mut log_density, mut inside) = (Vec::new(), [0.0; 2]);
        let (mut squares, mut ok) = (0.0, 0usize);
        for block in blocks {
            for left in precision.left_out(block)? {
                log_density.push(left.log_density);
                inside[0] += f64::from(u8::from(left.pull.abs() < 1.0));
                inside[1] += f64::from(u8::from(left.pull.abs() < 2.0));
                if precision.channels[left.channel].is_ok {
                    squares += left.innovation.powi(2);
                    ok += 1;
                }
            }
        }
        let n = log_density.len().max(1) as f64;
        Ok(Self { log_density, rms: (squares / ok.max(1) as f64).sqrt(), inside: inside.map(|count| count / n) })
    }

    /// Expected log predictive density.
    pub fn elpd(&self) -> f64 {
        self.log_density.iter().sum()
    }

    /// Gain over another, and its standard error.
    pub fn gain_over(&self, other: &Self) -> (f64, f64) {
        let gains: Vec<f64> = self.log_density.iter().zip(&other.log_density).map(|(one, other)| one - other).collect();
        let n = gains.len() as f64;
        let gain: f64 = gains.iter().sum();
        let spread: f64 = gains.iter().map(|g| (g - gain / n).powi(2)).sum();
        (gain, (spread * n / (n - 1.0).max(1.0)).sqrt())
    }
}

/// One reading that was left out.
struct LeftOut {
    channel: usize,
    log_density: f64,
    /// Measured less predicted, and the same over its standard deviation given the readings after it.
    innovation: f64,
    pull: f64,
}

/// The precision of all readings, in units of their noise.
struct Precision<'d> {
    data: &'d Data,
    fitted: &'d Fitted,
    channels: Vec<OfChannel>,
}

/// `T^T`, `T^T T`, `T^T J` and `T^T r` of one channel of a recording.
struct OfChannel {
    /// Pool of each row, counted through all recordings.
    pools: Vec<usize>,
    /// First of its rows among those of all.
    start: usize,
    sigma: f64,
    /// True of a monitor in state ok.
    is_ok: bool,
    back: DMatrix<f64>,
    gram: DMatrix<f64>,
    cross: DMatrix<f64>,
    pull: DVector<f64>,
}

impl<'d> Precision<'d> {
    fn from_fit(data: &'d Data, fitted: &'d Fitted) -> Self {
        let mut start = 0;
        let mut channels = Vec::new();
        for (own, pools) in data.campaigns().zip(data.pools_of_each()) {
            for (c, channel) in own.channels.iter().enumerate() {
                let n = channel.rows.len();
                let back = channel.whiten(DMatrix::identity(n, n)).transpose();
                let (jacobian, residual) = (fitted.jacobian.rows(start, n), fitted.residual.rows(start, n));
                channels.push(OfChannel {
                    pools: channel.rows.iter().map(|pool| pools.start + pool).collect(),
                    start,
                    sigma: channel.sigma,
                    is_ok: own.health().get(c).is_some_and(|one| one.state == MonitorState::Ok),
                    gram: &back * back.transpose(),
                    cross: &back * jacobian,
                    pull: &back * residual,
                    back,
                });
                start += n;
            }
        }
        Self { channels, data, fitted }
    }

    /// The readings of a block: channel, and row in the channel.
    fn readings(&self, block: &Block) -> Vec<(usize, usize)> {
        let rows = |(c, channel): (usize, &OfChannel)| {
            let of_pool = |pool: &usize| channel.pools.binary_search(pool).ok().map(|row| (c, row));
            block.iter().filter_map(of_pool).collect::<Vec<_>>()
        };
        self.channels.iter().enumerate().flat_map(rows).collect()
    }

    /// Factor of `K_FF` of some readings, and `(T^T r)_F`.
    fn of_readings(&self, readings: &[(usize, usize)]) -> Result<(Factor, DVector<f64>), FitError> {
        let n = readings.len();
        let mut cross = DMatrix::zeros(self.fitted.u.len(), n);
        for (mut column, &(c, row)) in cross.column_iter_mut().zip(readings) {
            column.tr_copy_from(&self.channels[c].cross.row(row));
        }
        let taken = self.fitted.factor.whiten(&cross);
        let mut precision = -gram(&taken);
        for (i, &(c, row)) in readings.iter().enumerate() {
            for (j, &(_, other)) in readings.iter().enumerate().filter(|(_, (of, _))| *of == c) {
                precision[(i, j)] += self.channels[c].gram[(row, other)];
            }
        }
        let pull = DVector::from_iterator(n, readings.iter().map(|&(c, row)| self.channels[c].pull[row]));
        Ok((Factor::of(precision).ok_or(FitError::Degenerate)?, pull))
    }

    /// Whitened signatures less what the fit absorbs of them, one a column, as they stand beside `T^T r`.
    fn back(&self, left: &DMatrix<f64>) -> DMatrix<f64> {
        let mut back = left.clone();
        for channel in &self.channels {
            let (start, n) = (channel.start, channel.pools.len());
            let part = &channel.back * back.rows(start, n);
            back.rows_mut(start, n).copy_from(&part);
        }
        back
    }

    /// What a block's readings say of some signatures beside what all readings say: of each the part of its pull `d P r` and of its power
    /// `d P d` that goes with the block. `back` as from [`Precision::back`].
    fn shares(&self, back: &DMatrix<f64>, block: &Block) -> Result<Vec<SignatureScore>, FitError> {
        let readings = self.readings(block);
        let (factor, pull) = self.of_readings(&readings)?;
        let rows: Vec<usize> = readings.iter().map(|&(c, row)| self.channels[c].start + row).collect();
        let signatures = back.select_rows(&rows);
        let pulls = signatures.transpose() * factor.solve(&pull);
        let powers = factor.whiten(&signatures).column_iter().map(|one| one.norm_squared()).collect::<Vec<_>>();
        Ok(pulls.iter().zip(powers).map(|(&pull, power)| SignatureScore { pull, power }).collect())
    }

    /// `ln` of the determinant of what monitors have in common in a block's pools, in units of their own noise.
    fn mixed_log_det(&self, block: &Block) -> f64 {
        let of_each = self.data.campaigns().zip(self.data.pools_of_each()).map(|(own, pools)| {
            let inside: Vec<usize> = block.iter().filter_map(|pool| pool.checked_sub(pools.start)).collect();
            let inside: Vec<usize> = inside.into_iter().filter(|pool| *pool < own.pools.count).collect();
            inside.into_iter().map(|pool| own.mixing.log_det_of(pool)).sum::<f64>()
        });
        of_each.sum()
    }

    fn left_out(&self, block: &Block) -> Result<Vec<LeftOut>, FitError> {
        let readings = self.readings(block);
        let n = readings.len();
        let (factor, pull) = self.of_readings(&readings)?;
        let innovation = factor.solve(&pull);
        let pulls = factor.whiten(&pull);
        let scales: Vec<f64> = factor.diagonal().collect();
        let mixed = self.mixed_log_det(block) / n.max(1) as f64;
        let one = |(i, &(channel, _)): (usize, &(usize, usize))| {
            let sigma = self.channels[channel].sigma;
            let scale = scales[i] / sigma;
            let log_density = scale.ln() - 0.5 * (pulls[i].powi(2) + core::f64::consts::TAU.ln() + mixed);
            LeftOut { channel, log_density, innovation: innovation[i] * sigma, pull: pulls[i] }
        };
        Ok(readings.iter().enumerate().map(one).collect())
    }
}

/// Folds of pools from which the choice of an effect is left out.
const FOLDS: usize = 5;

/// Gain of held-out log density where not only the amplitude but kind and place too are chosen without the held-out pools: each of five
/// folds is predicted by all of some terms and by none of them, each with the weight that the other folds give it, to first order about a
/// fit without any. What was chosen by chance has less than nothing.
///
/// With the score `B = (d P r)^2/(1 + d P d)/2 - ln(1 + d P d)/2` of a term by all pools and `B_kept` by those outside the fold, the fold's density given
/// the others is larger by `exp(B - B_kept)` with the term than without; the mixture gains
///
/// `ln(1 + sum of exp(B - penalty)) - ln(1 + sum of exp(B_kept - penalty))`.
pub fn gain_of_choice(choice: &Choice) -> Result<f64, FitError> {
    let (data, all) = (choice.data, &choice.scores);
    let precision = Precision::from_fit(data, choice.without);
    let back = precision.back(&choice.left);
    // ln of the weight of any term over that of none
    let odds = |scores: &mut dyn Iterator<Item = SignatureScore>| {
        let weights: Vec<f64> = choice.log_weights(scores).chain([0.0]).collect();
        let largest = weights.iter().copied().fold(0.0, f64::max);
        largest + weights.iter().map(|weight| (weight - largest).exp()).sum::<f64>().ln()
    };
    let by_all = odds(&mut all.iter().copied());
    let mut gain = 0.0;
    for fold in 0..FOLDS {
        let block: Block = (fold..pools_of(data)).step_by(FOLDS).collect();
        let shares = precision.shares(&back, &block)?;
        let kept = |(all, share): (&SignatureScore, &SignatureScore)| SignatureScore {
            pull: all.pull - share.pull,
            power: (all.power - share.power).max(0.0),
        };
        gain += by_all - odds(&mut all.iter().zip(&shares).map(kept));
    }
    Ok(gain)
}

/// The fit of a hypothesis without some terms, and without the families that predict as these do, to compare its predictions with: what is ordinary keeps the
/// size that it has in another fit.
pub(super) fn without_terms(
    data: &Data,
    fitted: &Fitted,
    terms: &[Term],
    from: &Hypothesis,
) -> Result<Fitted, FitError> {
    let less = from.without_terms(|term| terms.contains(term));
    lessened(data, fitted, terms.iter().fold(less, |less, term| less.without_family(*term, data)))
}

/// The fit of a hypothesis with fewer effects than another fit: vars that are stable with an effect may be unstable without it, and so may ordinary
/// imperfections that grow in its place.
pub(super) fn lessened(data: &Data, fitted: &Fitted, other: Hypothesis) -> Result<Fitted, FitError> {
    let far = DVector::zeros(fitted.params.len());
    let stable = |fitted: &Fitted| fitted.is_stable(data);
    let near = Fitted::from_guess(data, &other, &fitted.guess(data, &other)).ok().filter(stable);
    let other_than_near = || Fitted::from_guess(data, &other, &far).ok().filter(stable);
    let bare = Hypothesis { ordinary: Vec::new(), ..other.clone() };
    let less = near.or_else(other_than_near).map_or_else(|| Fitted::from_guess(data, &bare, &far), Ok)?;
    Ok(if data.is_about_effects { about_itself(data, less) } else { less })
}
