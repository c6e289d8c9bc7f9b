//! The result of a recording, the same from the core and from the batch fit: as JSON and as a table.

use core::fmt;

use comfy_table::{CellAlignment, Table};
use estimator::{FitQuality, Health, Marginal, MonitorState, Prior};
use inference::nuts::{NutsRun, UNMIXED};
use inference::recording::Row;
use inference::{BatchFit, Campaign, FittedTune, Lack, Meter, Recording, Reduced, Summary};
use serde::Serialize;
use studies::Sampled;
use twin::{Hold, Optics, Ring};

use crate::output::{fill, table};
use crate::record::EstimateRecord;

/// Standard deviations between a measured tune and the model's that noise does not explain.
const TUNES_DISAGREE: f64 = 4.0;

/// Vars with error bars, and how well they describe a recording. Field names are those of the command's JSON.
#[derive(Debug, Clone, Serialize)]
#[allow(missing_docs)] // named after what they are
pub struct FitResult {
    pub recording: String,
    pub method: &'static str,
    pub model: &'static str,
    pub frames: usize,
    pub rejected_frames: u32,
    pub vars: Vec<Var>,
    pub covariance: Vec<Vec<f64>>,
    pub chi2_per_dof: f64,
    /// The core's alarm: its readings are further off than noise explains.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub mismatch: Option<bool>,
    /// The model's.
    pub tunes: Option<Tunes>,
    pub tunes_measured: TunesMeasured,
    /// What the recording lacks to say anything: the vars are then those of the prior, but for measured tunes.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub lack: Option<String>,
    pub monitors: Vec<Monitor>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub log_evidence: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub timing: Option<Timing>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub nuts: Option<Sampling>,
    /// How it was found, for a person.
    #[serde(skip)]
    pub notes: Vec<String>,
}

/// One quadrupole factor: mean, standard deviation and quantiles of its truncated posterior [1].
#[derive(Debug, Clone, Serialize)]
#[allow(missing_docs)] // named after what they are
pub struct Var {
    pub name: String,
    pub mean: f64,
    pub sigma: f64,
    pub q025: f64,
    pub q16: f64,
    pub q84: f64,
    pub q975: f64,
    /// At a bound of the prior's range.
    pub clipped: bool,
}

/// Tunes of the twin at the means.
#[derive(Debug, Clone, Copy, Serialize)]
#[allow(missing_docs)] // named after what they are
pub struct Tunes {
    pub x: f64,
    pub y: f64,
}

/// Tunes as the meter measured them, with the model's integer parts; none without enough readings of it.
#[derive(Debug, Clone, Copy, Default, Serialize)]
#[allow(missing_docs)] // named after what they are
pub struct TunesMeasured {
    pub x: Option<TuneMeasured>,
    pub y: Option<TuneMeasured>,
}

/// Mean of what the meter says of one tune, and its standard deviation, the meter's calibration included.
#[derive(Debug, Clone, Copy, Serialize)]
#[allow(missing_docs)] // named after what they are
pub struct TuneMeasured {
    pub mean: f64,
    pub sigma: f64,
}

/// State of one monitor.
#[derive(Debug, Clone, Serialize)]
#[allow(missing_docs)] // named after what they are
pub struct Monitor {
    pub name: String,
    pub state: &'static str,
    pub sigma_mm: f64,
    pub rejected: u32,
}

/// Time from wire bytes to estimate [us].
#[derive(Debug, Clone, Copy, Serialize)]
#[allow(missing_docs)] // named after what they are
pub struct Timing {
    pub update_us_p50: f64,
    pub update_us_p99: f64,
    pub update_us_max: f64,
}

/// How well a posterior was sampled.
#[derive(Debug, Clone, Copy, Serialize)]
#[allow(missing_docs)] // named after what they are
pub struct Sampling {
    pub rhat_max: f64,
    pub ess_min: f64,
    pub divergences: usize,
    pub draws: usize,
    pub evaluations: u64,
    pub seconds: f64,
}

impl Var {
    /// Moments and quantiles of draws; the sampler's coordinates never reach a bound.
    fn of_draws(summary: &Summary) -> Self {
        let Summary { name, mean, sd, q025, q16, q84, q975, .. } = summary.clone();
        Self { name, mean, sigma: sd, q025, q16, q84, q975, clipped: false }
    }

    /// Moments and quantiles of a marginal of `ln var`.
    fn of_marginal(name: String, marginal: &Marginal, clipped: bool) -> Self {
        let (mean, sigma) = marginal.moments();
        let quantile = |p| f64::from(marginal.quantile(p));
        Self {
            name,
            mean: f64::from(mean),
            sigma: f64::from(sigma),
            q025: quantile(0.025),
            q16: quantile(0.16),
            q84: quantile(0.84),
            q975: quantile(0.975),
            clipped,
        }
    }

    fn cells(&self) -> [String; 4] {
        let mark = if self.clipped { "*" } else { "" };
        [
            format!("{}{mark}", self.name),
            format!("{:.4}", self.mean),
            format!("{:.2}", 100.0 * self.sigma),
            format!("{:.4}..{:.4}", self.q025, self.q975),
        ]
    }
}

impl FitResult {
    /// What a core says after its last frame, here or on a device; with the prior of each param.
    pub fn of_core(
        ring: &Ring,
        recording: &Recording,
        priors: &[Prior],
        last: &EstimateRecord,
        quality: FitQuality,
        timing: Timing,
    ) -> Self {
        let marginal = |(i, Prior { lower, upper, .. }): (usize, &Prior)| Marginal {
            mean: last.centre[i],
            sigma: last.params_sigma[i],
            lower: *lower,
            upper: *upper,
        };
        let marginals = priors.iter().enumerate().map(marginal);
        let each = ring.var_names().into_iter().zip(marginals).zip(&last.clipped);
        let vars: Vec<Var> = each.map(|((name, m), clipped)| Var::of_marginal(name, &m, *clipped)).collect();
        let (n, tunes) = (vars.len(), tunes(ring, &vars));
        Self {
            recording: recording.name.clone(),
            method: "laplace",
            model: "green",
            frames: last.frames as usize,
            rejected_frames: last.rejected_frames,
            covariance: (0..n).map(|i| (0..n).map(|j| f64::from(last.covariance_of(i, j))).collect()).collect(),
            tunes_measured: TunesMeasured::of_recording(recording, tunes.map(|tunes| [tunes.x, tunes.y])),
            lack: lack(recording).map(|lack| lack.to_string()),
            tunes,
            vars,
            chi2_per_dof: f64::from(quality.chi_square / quality.degrees_of_freedom),
            mismatch: Some(quality.is_mismatch()),
            monitors: last.monitors(),
            log_evidence: Some(f64::from(last.log_evidence)),
            timing: Some(timing),
            nuts: None,
            notes: Vec::new(),
        }
    }

    /// What the batch fit says.
    pub fn of_fit(campaign: &Campaign, fit: &BatchFit) -> Self {
        let bounds = |m: &Marginal| m.mean <= m.lower || m.mean >= m.upper;
        let each = campaign.ring.var_names().into_iter().zip(&fit.marginals);
        let vars: Vec<Var> = each.map(|(name, marginal)| Var::of_marginal(name, marginal, bounds(marginal))).collect();
        Self {
            method: "map",
            model: "twin",
            covariance: covariance(&vars, |i, j| fit.covariance[(i, j)]),
            vars,
            ..Self::of_both(campaign, fit)
        }
    }

    /// What draws of the posterior say.
    pub fn of_draws(reduced: &Reduced, model: &'static str, run: &NutsRun) -> Self {
        let sampled = Sampled::of(&run.draws);
        let vars: Vec<Var> = sampled.summary.iter().map(Var::of_draws).collect();
        let covariance = sampled.covariance();
        Self {
            method: "nuts",
            model,
            covariance: covariance.row_iter().map(|row| row.iter().copied().collect()).collect(),
            tunes: tunes(&reduced.campaign.ring, &vars),
            vars,
            nuts: Some(Sampling::of(&sampled, run)),
            ..Self::of_both(&reduced.campaign, &reduced.fit)
        }
    }

    /// What the batch fit says and the draws leave as it is.
    fn of_both(campaign: &Campaign, fit: &BatchFit) -> Self {
        let [x, y] = &fit.tunes;
        Self {
            recording: campaign.recording.name.clone(),
            method: "",
            model: "",
            frames: campaign.frames(),
            rejected_frames: 0,
            vars: Vec::new(),
            covariance: Vec::new(),
            chi2_per_dof: fit.chi2_per_dof,
            mismatch: None,
            tunes: Some(Tunes { x: x.model, y: y.model }),
            tunes_measured: TunesMeasured { x: measured(x), y: measured(y) },
            lack: fit.lack.map(|lack| lack.to_string()),
            monitors: monitors(&campaign.ring, &campaign.screened.health),
            log_evidence: None,
            timing: None,
            nuts: None,
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

    /// What a reader has to know before using the numbers.
    fn remarks(&self) -> Vec<String> {
        let clipped: Vec<&str> = self.vars.iter().filter(|v| v.clipped).map(|v| v.name.as_str()).collect();
        let remarks = [
            self.lack.as_ref().map(|lack| format!("{lack}: the result is the prior, but for measured tunes")),
            self.tunes.and_then(|tunes| self.tunes_measured.remark(&tunes)),
            (!clipped.is_empty()).then(|| format!("* at a bound of the prior's range: {}", clipped.join(", "))),
            (self.mismatch == Some(true))
                .then(|| "model and machine disagree beyond the noise: orbitcal diagnose may say why".into()),
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
        write!(f, "chi2/dof {:.4}", self.chi2_per_dof)?;
        if let Some(tunes) = &self.tunes {
            write!(f, ", tunes {:.4} {:.4}, {}", tunes.x, tunes.y, self.tunes_measured)?;
        }
        if self.rejected_frames > 0 {
            write!(f, ", {} frames refused", self.rejected_frames)?;
        }
        if let Some(t) = &self.timing {
            let [p50, p99, max] = [t.update_us_p50, t.update_us_p99, t.update_us_max];
            write!(f, "\nframe to estimate: median {p50:.0} us, 99 % within {p99:.0} us, slowest {max:.0} us")?;
        }
        self.notes.iter().try_for_each(|note| write!(f, "\n{}", fill(note)))
    }
}

impl TunesMeasured {
    /// What the meter says of a recording, with the integer parts of the model's.
    pub fn of_recording(recording: &Recording, model: Option<[f64; 2]>) -> Self {
        let time = recording.times();
        let one = |plane: usize| {
            // an RF offset moves the tune
            let tune = |row: &Row| row.tune[plane].filter(|_| row.rf_offset == 0.0).unwrap_or(f64::NAN);
            let tunes: Vec<f64> = recording.rows.iter().map(tune).collect();
            let meter = Meter::of(tunes.iter().zip(&time))?;
            Some(TuneMeasured { mean: meter.near(model.map_or(0.0, |tunes| tunes[plane])), sigma: meter.sigma })
        };
        Self { x: one(0), y: one(1) }
    }

    /// What is wrong with the model's, if anything is.
    fn remark(&self, model: &Tunes) -> Option<String> {
        let away = |plane: &str, measured: Option<TuneMeasured>, model: f64| {
            let pull = measured.map(|tune| (tune.mean - model) / tune.sigma)?;
            (pull.abs() > TUNES_DISAGREE).then(|| format!("tune {plane} by {pull:+.1} standard deviations"))
        };
        let both = [away("x", self.x, model.x), away("y", self.y, model.y)];
        let both: Vec<String> = both.into_iter().flatten().collect();
        (!both.is_empty()).then(|| {
            format!("measured tunes differ from the model's, {}: a wrong kick constant does that", both.join(" and "))
        })
    }
}

impl fmt::Display for TunesMeasured {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let word = |tune: Option<TuneMeasured>| {
            tune.map_or_else(|| "-".into(), |tune| format!("{:.4} ± {:.4}", tune.mean, tune.sigma))
        };
        match (self.x, self.y) {
            (None, None) => f.write_str("not measured"),
            (x, y) => write!(f, "measured {}, {}", word(x), word(y)),
        }
    }
}

fn measured(tune: &FittedTune) -> Option<TuneMeasured> {
    tune.measured.map(|(mean, sigma)| TuneMeasured { mean, sigma })
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
            rhat_max: sampled.summary.iter().map(|s| s.r_hat).fold(0.0, f64::max),
            ess_min: smallest(|s| s.ess_bulk.min(s.ess_tail)),
            divergences: run.draws.divergences(),
            draws: run.draws.chains.iter().map(|chain| chain.draws.len()).sum(),
            evaluations: run.evaluations,
            seconds: run.seconds,
        }
    }

    /// What is wrong with the sampling, if anything is.
    fn remark(&self) -> Option<String> {
        // not a number where a chain has not moved at all
        let has_mixed = self.rhat_max <= UNMIXED;
        (!has_mixed).then(|| {
            format!(
                "R-hat is {:.3}, above {UNMIXED}: the chains do not agree yet. Sample longer (--warm-up, --draws) before \
                 you use these numbers",
                self.rhat_max
            )
        })
    }
}

/// Vars from means and standard deviations of `ln var`, truncated to the prior's range.
pub fn vars_of(ring: &Ring, mean: &[f64], sigma: &[f64]) -> Vec<Var> {
    let prior = inference::Prior::of(ring);
    let var = |(i, name)| Var::of_marginal(name, &prior.marginal(i, mean[i], sigma[i]), false);
    ring.var_names().into_iter().enumerate().map(var).collect()
}

/// Covariance of the vars, `mean_i mean_j` times that of their logarithms.
fn covariance(vars: &[Var], of_params: impl Fn(usize, usize) -> f64) -> Vec<Vec<f64>> {
    let row = |i: usize| (0..vars.len()).map(|j| vars[i].mean * vars[j].mean * of_params(i, j)).collect();
    (0..vars.len()).map(row).collect()
}

/// Tunes of the twin at the means; none if that ring is unstable.
fn tunes(ring: &Ring, vars: &[Var]) -> Option<Tunes> {
    let means: Vec<f64> = vars.iter().map(|v| v.mean).collect();
    let ring = ring.with_vars(&means);
    let tunes = Optics::of(&ring, Hold::Momentum { delta: 0.0 }).ok()?.tunes().ok()?;
    Some(Tunes { x: tunes.x, y: tunes.y })
}

/// State of the monitors of a ring.
pub fn monitors(ring: &Ring, health: &[Health]) -> Vec<Monitor> {
    let monitor = |(name, health): (String, &Health)| Monitor {
        name,
        state: word(health.state),
        sigma_mm: f64::from(health.noise) * 1e3,
        rejected: health.rejected,
    };
    ring.monitor_names().into_iter().zip(health).map(monitor).collect()
}

/// The word for a state in tables and JSON.
pub fn word(state: MonitorState) -> &'static str {
    match state {
        MonitorState::Ok => "ok",
        MonitorState::Noisy => "noisy",
        MonitorState::Jumps => "jumps",
        MonitorState::Dead => "dead",
    }
}

/// The monitors that are not ok, in words.
pub fn faults(monitors: &[Monitor]) -> String {
    let fault =
        |m: &Monitor| format!("{} {} ({:.2} mm, {} readings rejected)", m.name, m.state, m.sigma_mm, m.rejected);
    let faults: Vec<String> = monitors.iter().filter(|m| m.state != word(MonitorState::Ok)).map(fault).collect();
    if faults.is_empty() { "all ok".into() } else { faults.join("; ") }
}

impl EstimateRecord {
    /// State of its monitors.
    fn monitors(&self) -> Vec<Monitor> {
        let monitor = |b: usize| Monitor {
            name: self.names.monitors[b].clone(),
            state: word(self.monitor_state[b]),
            sigma_mm: f64::from(self.monitor_sigma[b]) * 1e3,
            rejected: self.monitor_rejected[b],
        };
        (0..self.reading.len()).map(monitor).collect()
    }
}
