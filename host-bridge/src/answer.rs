//! The answer to a recording, the same from the core and from the batch fit: as JSON and as a table.

use comfy_table::{CellAlignment, Table, presets};
use estimator::{FitQuality, Health, Marginal, MonitorState, Setup};
use inference::nuts::NutsRun;
use inference::stream::BoosterEstimate;
use inference::{BatchFit, Campaign, Recording, Summary};
use serde::Serialize;
use studies::Sampled;
use twin::{Hold, Optics, Ring};

/// Vars with error bars, and how well they describe a recording. Field names are those of the command's JSON.
#[derive(Debug, Clone, Serialize)]
#[allow(missing_docs)] // named after what they are
pub struct Answer {
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
    pub tunes: Option<Tunes>,
    pub monitors: Vec<Monitor>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub log_evidence: Option<f64>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub timing: Option<Timing>,
    #[serde(skip_serializing_if = "Option::is_none")]
    pub nuts: Option<Sampling>,
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
#[derive(Debug, Clone, Serialize)]
#[allow(missing_docs)] // named after what they are
pub struct Tunes {
    pub x: f64,
    pub y: f64,
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
}

impl Answer {
    /// What a core says after its last frame, here or on a device; `of_params` is the covariance of two `ln var`.
    pub fn of_core(
        ring: &Ring,
        recording: &Recording,
        setup: &Setup,
        last: &BoosterEstimate,
        of_params: impl Fn(usize, usize) -> f32,
        quality: FitQuality,
        timing: Timing,
    ) -> Self {
        let marginals: Vec<Marginal> = (0..48).filter_map(|i| last.marginal(i, &setup.prior)).collect();
        let vars = vars(ring, &marginals, |i| last.clipped >> i & 1 == 1);
        Self {
            recording: recording.name.clone(),
            method: "laplace",
            model: "green",
            frames: last.frames as usize,
            rejected_frames: last.rejected_frames,
            covariance: covariance(&vars, |i, j| f64::from(of_params(i, j))),
            tunes: tunes(ring, &vars),
            vars,
            chi2_per_dof: f64::from(quality.chi_square / quality.degrees_of_freedom),
            mismatch: Some(quality.is_mismatch()),
            monitors: monitors(ring, &last.health),
            log_evidence: Some(f64::from(last.log_evidence)),
            timing: Some(timing),
            nuts: None,
        }
    }

    /// What the batch fit says.
    pub fn of_fit(ring: &Ring, recording: &Recording, fit: &BatchFit) -> Self {
        let bounds = |m: &Marginal| m.mean <= m.lower || m.mean >= m.upper;
        let vars = vars(ring, &fit.marginals, |i| bounds(&fit.marginals[i]));
        Self {
            recording: recording.name.clone(),
            method: "map",
            model: "twin",
            frames: recording.rows.len(),
            rejected_frames: 0,
            covariance: covariance(&vars, |i, j| fit.covariance[(i, j)]),
            vars,
            chi2_per_dof: fit.chi2_per_dof,
            mismatch: None,
            tunes: Some(Tunes { x: fit.tunes.x, y: fit.tunes.y }),
            monitors: monitors(ring, &fit.screened.health),
            log_evidence: None,
            timing: None,
            nuts: None,
        }
    }

    /// What draws of the posterior say.
    pub fn of_draws(ring: &Ring, campaign: &Campaign, model: &'static str, run: &NutsRun) -> Self {
        let sampled = Sampled::of(&run.draws);
        let vars: Vec<Var> = sampled.summary.iter().map(Var::of_draws).collect();
        let covariance = sampled.covariance();
        let draws = run.draws.chains.iter().map(|chain| chain.draws.len()).sum();
        Self {
            recording: campaign.recording.name.clone(),
            method: "nuts",
            model,
            frames: campaign.recording.rows.len(),
            rejected_frames: 0,
            covariance: covariance.row_iter().map(|row| row.iter().copied().collect()).collect(),
            tunes: tunes(ring, &vars),
            vars,
            chi2_per_dof: campaign.fit.chi2_per_dof,
            mismatch: None,
            monitors: monitors(ring, &campaign.fit.screened.health),
            log_evidence: None,
            timing: None,
            nuts: Some(Sampling {
                rhat_max: sampled.summary.iter().map(|s| s.r_hat).fold(0.0, f64::max),
                ess_min: sampled.summary.iter().map(|s| s.ess_bulk.min(s.ess_tail)).fold(f64::INFINITY, f64::min),
                divergences: run.draws.divergences(),
                draws,
                evaluations: run.evaluations,
                seconds: run.seconds,
            }),
        }
    }

    /// The answer for a person.
    pub fn print(&self) {
        println!("{}: {} frames, method {}, model {}\n", self.recording, self.frames, self.method, self.model);
        println!("{}", self.table());
        let faulty = self.monitors.iter().filter(|m| m.state != "ok");
        let faulty: Vec<String> = faulty
            .map(|m| format!("{} {} ({:.2} mm, {} readings refused)", m.name, m.state, m.sigma_mm, m.rejected))
            .collect();
        println!("monitors: {}", if faulty.is_empty() { "all ok".into() } else { faulty.join("; ") });
        let clipped: Vec<&str> = self.vars.iter().filter(|v| v.clipped).map(|v| v.name.as_str()).collect();
        if !clipped.is_empty() {
            println!("at a bound of 0.94..1.06: {}", clipped.join(", "));
        }
        if self.mismatch == Some(true) {
            println!("model and machine disagree beyond the noise: orbitcal diagnose may say why");
        }
        print!("chi2/dof {:.4}", self.chi2_per_dof);
        if let Some(tunes) = &self.tunes {
            print!(", tunes {:.4} {:.4}", tunes.x, tunes.y);
        }
        if self.rejected_frames > 0 {
            print!(", {} frames refused", self.rejected_frames);
        }
        println!();
        if let Some(t) = &self.timing {
            println!(
                "frame to estimate: median {:.0} us, 99 % within {:.0} us, slowest {:.0} us",
                t.update_us_p50, t.update_us_p99, t.update_us_max
            );
        }
    }

    /// Both families side by side, 24 rows.
    fn table(&self) -> Table {
        let mut table = Table::new();
        table.load_style(presets::ASCII_BORDERS_ONLY_CONDENSED);
        let head = ["var", "mean", "sigma/%", "95 % interval"];
        table.set_header(head.iter().chain(&head));
        let half = self.vars.len().div_ceil(2);
        for (left, right) in self.vars.iter().take(half).zip(self.vars.iter().skip(half)) {
            table.add_row([left, right].iter().flat_map(|v| v.cells()));
        }
        for (i, column) in table.column_iter_mut().enumerate() {
            column.set_cell_alignment(if i % 4 == 0 { CellAlignment::Left } else { CellAlignment::Right });
        }
        table
    }
}

impl Var {
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

/// Vars from means and standard deviations of `ln var`, truncated to the prior's range.
pub fn vars_of(ring: &Ring, mean: &[f64], sigma: &[f64]) -> Vec<Var> {
    let prior = estimator::Prior::lognormal(inference::stream::PRIOR_WIDTH);
    let marginal = |(mean, sigma): (&f64, &f64)| Marginal {
        mean: *mean as f32,
        sigma: *sigma as f32,
        lower: prior.lower,
        upper: prior.upper,
    };
    let marginals: Vec<Marginal> = mean.iter().zip(sigma).map(marginal).collect();
    vars(ring, &marginals, |_| false)
}

fn vars(ring: &Ring, marginals: &[Marginal], clipped: impl Fn(usize) -> bool) -> Vec<Var> {
    let var = |(i, (name, marginal)): (usize, (String, &Marginal))| {
        let (mean, sigma) = marginal.moments();
        let quantile = |p| f64::from(marginal.quantile(p));
        Var {
            name,
            mean: f64::from(mean),
            sigma: f64::from(sigma),
            q025: quantile(0.025),
            q16: quantile(0.16),
            q84: quantile(0.84),
            q975: quantile(0.975),
            clipped: clipped(i),
        }
    };
    ring.var_names().into_iter().zip(marginals).enumerate().map(var).collect()
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
