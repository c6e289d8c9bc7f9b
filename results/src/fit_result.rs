//! The result of a recording, the same from the core and from the batch fit: as JSON and as a table.

mod monitor;
mod tunes;
mod var;

use core::fmt;
use std::borrow::Cow;

use comfy_table::{CellAlignment, Table};
use estimator::{FitQuality, Marginal, Walk};
use inference::nuts::{NutsRun, UNMIXED};
use inference::{
    BatchFit, Campaign, Draws, Imitation, Imperfection, Lack, OpticsFunctions, Prior, Recording, Reduced, Summary,
    THROUGHOUT,
};
use nalgebra::DMatrix;
use schemars::JsonSchema;
use serde::Serialize;
use studies::Sampled;
use twin::{OrbitError, Ring};

pub use monitor::{Monitor, faults, monitors, state_word};
pub use tunes::{TuneMeasured, Tunes, TunesMeasured};
use tunes::{measured, tunes};
use var::covariance;
pub use var::{Var, vars_of};

use crate::imperfection::ImperfectionResult;
use crate::optics::{OpticsAt, optics_at, places};
use crate::output::{fill, table};
use crate::record::{EstimateRecord, Remarked};

/// Vars with error bars, and how well they describe a recording. Field names are those of the command's JSON.
#[derive(Debug, Clone, Serialize, JsonSchema)]
#[allow(missing_docs)] // named after what they are
pub struct FitResult {
    pub recording: String,
    /// File name of the machine's lattice.
    pub lattice: String,
    pub method: &'static str,
    pub model: &'static str,
    pub frames: usize,
    pub rejected_frames: u32,
    /// What the core said of frames as a whole; the batch fit has no such words.
    #[serde(flatten)]
    pub remarked: Option<Remarked>,
    pub vars: Vec<Var>,
    pub covariance: Vec<Vec<f64>>,
    /// None without degrees of freedom.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub chi2_per_dof: Option<f64>,
    /// The alarm: readings are further off than noise explains.
    pub mismatch: bool,
    /// The model's.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub tunes: Option<Tunes>,
    pub tunes_measured: TunesMeasured,
    /// At monitors and quadrupoles, of a fit whose ring is stable.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub optics: Vec<OpticsAt>,
    /// What the recording lacks to say anything: the vars are then those of the prior, but for measured tunes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lack: Option<String>,
    pub monitors: Vec<Monitor>,
    /// What the design may be off by throughout the ring, of a batch fit.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub imperfections: Vec<ImperfectionResult>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub log_evidence: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub timing: Option<Timing>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub nuts: Option<Sampling>,
    /// Share of the frames that were predicted outside the range that the model was made for; only of a model that has one.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub extrapolated: Option<f64>,
    /// What of the design is off by more than ordinary, for a person.
    #[serde(skip)]
    pub off: Option<String>,
    /// The optics at every element, of a batch fit.
    #[serde(skip)]
    pub calibrated: Option<OpticsFunctions>,
    /// How it was found, for a person.
    #[serde(skip)]
    pub notes: Vec<String>,
}

/// Time from wire bytes to estimate (`update`); with the longest slice of work before it, for whose end it may have to wait (`frame`);
/// and with all such work since the frame before (`prepared`) [us].
#[derive(Debug, Clone, Copy, Serialize, JsonSchema)]
#[allow(missing_docs)] // named after what they are
pub struct Timing {
    pub update_us_p50: f64,
    pub update_us_p99: f64,
    pub update_us_max: f64,
    pub frame_us_p50: f64,
    pub frame_us_p99: f64,
    pub frame_us_max: f64,
    pub prepared_us_p50: f64,
    pub prepared_us_p99: f64,
    pub prepared_us_max: f64,
}

impl fmt::Display for Timing {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let line = |f: &mut fmt::Formatter<'_>, what: &str, [p50, p99, max]: [f64; 3]| {
            write!(f, "{what}: median {p50:.0} us, 99 % within {p99:.0} us, slowest {max:.0} us")
        };
        line(f, "frame to estimate", [self.update_us_p50, self.update_us_p99, self.update_us_max])?;
        if self.prepared_us_max == self.update_us_max {
            return Ok(()); // a device, which prepares unseen
        }
        line(f, "\npreparing one slice", [self.frame_us_p50, self.frame_us_p99, self.frame_us_max])?;
        line(f, "\npreparing all slices", [self.prepared_us_p50, self.prepared_us_p99, self.prepared_us_max])
    }
}

/// How well a posterior was sampled.
#[derive(Debug, Clone, Copy, Serialize, JsonSchema)]
#[allow(missing_docs)] // named after what they are
pub struct Sampling {
    pub rhat_max: f64,
    pub ess_min: f64,
    pub divergences: usize,
    pub draws: usize,
    pub evaluations: u64,
    pub seconds: f64,
}

/// Frames whose tunes are those of vars that walk: 20 s of the Booster, in which the walk of `--follow` is a quarter of an error bar.
const LATEST: usize = 100;

/// The last frames of a recording.
fn latest(recording: &Recording) -> Cow<'_, Recording> {
    let rows = recording.rows[recording.rows.len().saturating_sub(LATEST)..].to_vec();
    Cow::Owned(Recording {
        rows,
        name: recording.name.clone(),
        header: recording.header.clone(),
        other: recording.other.clone(),
    })
}

impl FitResult {
    /// What a core says after its last frame, here or on a device, whose params walked by so much; the core takes the design for exact, and here its
    /// error bars get room for what vars may imitate ([`Imitation`]).
    ///
    /// # Errors
    /// [`OrbitError`] if the design, or one beside it, has no stable orbit.
    pub fn of_core(
        model: &'static str,
        ring: &Ring,
        (recording, walk): (&Recording, Walk),
        last: &EstimateRecord,
        quality: FitQuality,
        timing: Timing,
    ) -> Result<Self, OrbitError> {
        let prior = Prior::from_ring(ring);
        let of_params = widened(ring, recording, last)?;
        let marginal = |i: usize| prior.marginal(i, last.centre[i].into(), of_params[(i, i)].sqrt());
        let marginals = (0..prior.len()).map(marginal);
        let each = ring.var_names().into_iter().zip(marginals).zip(&last.clipped);
        let vars: Vec<Var> = each.map(|((name, m), clipped)| Var::of_marginal(name, &m, *clipped)).collect();
        // vars that walk are those of the last frames, and so are their tunes
        let seen = if walk.params > 0.0 { latest(recording) } else { Cow::Borrowed(recording) };
        let tunes = tunes(&recording.powered(ring), last, &seen.mean_supplies());
        Ok(Self {
            recording: recording.name.clone(),
            lattice: recording.header.lattice.clone(),
            method: "laplace",
            model,
            frames: last.frames.saturating_sub(last.remarked.put_aside_frames) as usize,
            rejected_frames: last.rejected_frames,
            remarked: Some(last.remarked),
            covariance: covariance(&vars, |i, j| of_params[(i, j)]),
            tunes_measured: TunesMeasured::of_recording(&seen, tunes.map(|tunes| [tunes.x, tunes.y])),
            lack: lack(recording).map(|lack| lack.to_string()),
            tunes,
            vars,
            chi2_per_dof: (quality.degrees_of_freedom > 0.0)
                .then(|| f64::from(quality.chi_square / quality.degrees_of_freedom)),
            mismatch: quality.is_mismatch(),
            monitors: last.monitors(),
            calibrated: None,
            off: None,
            imperfections: Vec::new(),
            optics: Vec::new(),
            log_evidence: Some(f64::from(last.log_evidence)),
            timing: Some(timing),
            nuts: None,
            extrapolated: None,
            notes: Vec::new(),
        })
    }

    /// What the batch fit says; where the design may be wrong, with room for what vars imitate of that.
    pub fn of_fit(campaign: &Campaign, fit: &BatchFit, imitation: Option<&Imitation>) -> Self {
        let bounds = |m: &Marginal| m.mean <= m.lower || m.mean >= m.upper;
        let of_params = imitation.map_or_else(|| fit.covariance.clone(), |one| one.widened(&fit.covariance));
        let var = |(i, (name, found)): (usize, (String, &Marginal))| {
            let marginal = campaign.prior.marginal(i, found.mean.into(), of_params[(i, i)].sqrt());
            Var::of_marginal(name, &marginal, bounds(found))
        };
        let vars: Vec<Var> = campaign.ring.var_names().into_iter().zip(&fit.marginals).enumerate().map(var).collect();
        Self {
            method: "map",
            model: "twin",
            covariance: covariance(&vars, |i, j| of_params[(i, j)]),
            vars,
            ..Self::of_both(campaign, fit)
        }
    }

    /// What draws of the posterior say, which a run gave.
    pub fn of_draws(reduced: &Reduced, model: &'static str, run: &NutsRun, draws: &Draws) -> Self {
        let sampled = Sampled::of(draws);
        let vars: Vec<Var> = sampled.summary.iter().map(Var::of_draws).collect();
        let covariance = sampled.covariance();
        Self {
            method: "nuts",
            model,
            covariance: covariance.row_iter().map(|row| row.iter().copied().collect()).collect(),
            vars,
            nuts: Some(Sampling::of(&Sampled::of(&run.draws), run)),
            ..Self::of_both(&reduced.campaign, &reduced.fit)
        }
    }

    /// What the batch fit says and the draws leave as it is; without optics where the ring as fitted is unstable.
    fn of_both(campaign: &Campaign, fit: &BatchFit) -> Self {
        let ([x, y], ring) = (&fit.tunes, &campaign.ring);
        let calibrated = fit.optics(campaign).ok();
        let sigma = calibrated.as_ref().map(|(_, (_, tunes))| *tunes);
        let of_places = |(optics, (sigma, _)): &OpticsFunctions| optics_at(ring, &places(ring), &optics.twiss, sigma);
        Self {
            recording: campaign.recording.name.clone(),
            lattice: campaign.recording.header.lattice.clone(),
            method: "",
            model: "",
            frames: campaign.frames(),
            rejected_frames: 0,
            remarked: None,
            vars: Vec::new(),
            covariance: Vec::new(),
            chi2_per_dof: Some(fit.chi2_per_dof).filter(|chi2| chi2.is_finite()),
            mismatch: fit.mismatch,
            tunes: Some(Tunes::of_fit([x.model, y.model], sigma)),
            tunes_measured: TunesMeasured { x: measured(x), y: measured(y) },
            optics: calibrated.as_ref().map(of_places).unwrap_or_default(),
            calibrated,
            lack: fit.lack.map(|lack| lack.to_string()),
            monitors: monitors(&campaign.ring, &campaign.screened.health, &campaign.screened.excluded.tallies()),
            off: Imperfection::told(&fit.imperfections()),
            imperfections: fit.imperfections().iter().map(ImperfectionResult::from).collect(),
            log_evidence: None,
            timing: None,
            nuts: None,
            extrapolated: None,
            notes: Vec::new(),
        }
    }

    /// One var a row, or two where their names are short enough for 80 columns.
    fn table(&self) -> Table {
        let longest = self.vars.iter().map(|var| var.name.len()).max().unwrap_or(0);
        let across = if longest <= 4 { 2 } else { 1 };
        let head = ["var", "mean", "sigma/%", "95 % interval"];
        let mut table = table(head.into_iter().cycle().take(across * head.len()));
        let rows = self.vars.len().div_ceil(across);
        for i in 0..rows {
            let vars = self.vars.iter().skip(i).step_by(rows.max(1)).take(across);
            table.add_row(vars.flat_map(Var::cells));
        }
        for (i, column) in table.column_iter_mut().enumerate() {
            column.set_padding((1, u16::from(i + 1 == across * head.len())));
            column.set_cell_alignment(if i % 4 == 0 { CellAlignment::Left } else { CellAlignment::Right });
        }
        table
    }

    /// Chi-square per degree of freedom as people read it.
    pub(crate) fn chi2(&self) -> String {
        self.chi2_per_dof.map_or_else(|| "-".into(), |chi2| format!("{chi2:.4}"))
    }

    /// What of the design is off by more than ordinary, in words.
    pub(crate) fn throughout(&self) -> Option<String> {
        self.off.as_ref().map(|off| format!("{THROUGHOUT}: {off}"))
    }

    /// What a reader has to know before using the numbers.
    fn remarks(&self) -> Vec<String> {
        let clipped: Vec<&str> = self.vars.iter().filter(|v| v.clipped).map(|v| v.name.as_str()).collect();
        let remarks = [
            self.throughout(),
            self.lack.as_ref().map(|lack| format!("{lack}: the result is the prior, but for measured tunes")),
            self.tunes.and_then(|tunes| self.tunes_measured.remark(&tunes)),
            (!clipped.is_empty()).then(|| format!("* at a bound of the prior's range: {}", clipped.join(", "))),
            self.mismatch.then(|| "model and machine disagree beyond the noise: orbitcal diagnose may say why".into()),
            self.nuts.and_then(|nuts| nuts.remark()),
        ];
        remarks.into_iter().flatten().collect()
    }
}

/// The result for a person.
impl fmt::Display for FitResult {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{}: {} frames, method {}, model {}\n", self.recording, self.frames, self.method, self.model)?;
        writeln!(f, "{}", self.table())?;
        writeln!(f, "{}", fill(&format!("monitors: {}", faults(&self.monitors))))?;
        self.remarks().iter().try_for_each(|remark| writeln!(f, "{}", fill(remark)))?;
        write!(f, "chi2/dof {}", self.chi2())?;
        if let Some(tunes) = &self.tunes {
            write!(f, ", tunes {tunes}, {}", self.tunes_measured)?;
        }
        if self.rejected_frames > 0 {
            write!(f, ", {} frames refused", self.rejected_frames)?;
        }
        self.remarked.map_or(Ok(()), |remarked| write!(f, "{remarked}"))?;
        if let Some(share) = self.extrapolated.filter(|share| *share > 0.0) {
            let percent = 100.0 * share;
            let said = format!(
                "{percent:.0} % of the predictions lie outside the vars and tunes that the network was trained on"
            );
            write!(f, "\n{}", fill(&said))?;
        }
        self.timing.map_or(Ok(()), |timing| write!(f, "\n{timing}"))?;
        self.notes.iter().try_for_each(|note| write!(f, "\n{}", fill(note)))
    }
}

/// Covariance of each theta, with room for magnets that are off throughout the ring.
fn widened(ring: &Ring, recording: &Recording, last: &EstimateRecord) -> Result<DMatrix<f64>, OrbitError> {
    let of_params = |i: usize, j: usize| match i == j {
        true => f64::from(last.params_sigma[i]).powi(2),
        false => f64::from(last.covariance_of(i, j)) / f64::from(last.mean[i] * last.mean[j]),
    };
    let covariance = DMatrix::from_fn(last.centre.len(), last.centre.len(), of_params);
    Ok(Imitation::new(ring, recording)?.widened(&covariance))
}

/// What a recording lacks to say anything, by what was read and what was moved.
pub fn lack(recording: &Recording) -> Option<Lack> {
    let is_read = recording.rows.iter().any(|row| row.reading.iter().any(Option::is_some));
    // a recording without a kick has a nominal one of 1 rad
    let is_kicked = recording.nominal_kick() < 1.0 || recording.rows.iter().any(|row| row.rf_offset != 0.0);
    if is_read { (!is_kicked).then_some(Lack::Kick) } else { Some(Lack::Readings) }
}

impl Sampling {
    fn of(sampled: &Sampled, run: &NutsRun) -> Self {
        let smallest = |ess: fn(&Summary) -> f64| sampled.summary.iter().map(ess).fold(f64::INFINITY, f64::min);
        Self {
            rhat_max: sampled.largest_r_hat(),
            ess_min: smallest(|s| s.ess_bulk.min(s.ess_tail)),
            divergences: run.draws.divergences(),
            draws: run.draws.chains.iter().map(|chain| chain.draws.len()).sum(),
            evaluations: run.evaluations,
            seconds: run.seconds,
        }
    }

    /// What is wrong with the sampling, if anything is.
    fn remark(&self) -> Option<String> {
        (self.rhat_max > UNMIXED).then(|| {
            format!(
                "R-hat is {:.3}, above {UNMIXED}: the chains do not agree yet. Sample longer (--warm-up, --draws) before \
                 you use these numbers",
                self.rhat_max
            )
        })
    }
}
