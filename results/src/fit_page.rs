//! The report of a fit: the optics of the calibrated ring beside the design's, with error bars.
//!
//! The exact optics are taken at the means of the strengths.

use core::f64::consts::TAU;

use inference::OpticsFunctions;
use report::{Axes, Band, Figure, Page, Reference, Section, Series, Table};
use twin::{CalibratedOptics, Hold, Optics, OrbitError, Ring, Tunes, Twiss};

use crate::fit_result::{FitResult, TuneMeasured};

/// What each figure's band is.
const BAND: &str = "Bands are 68 % intervals.";

/// The calibrated optics beside the design's, at the entrance of every element and at the end of the ring.
struct Calibrated<'r> {
    ring: &'r Ring,
    result: &'r FitResult,
    /// Path length [m].
    s: Vec<f64>,
    design: (Vec<Twiss>, Tunes),
    optics: &'r CalibratedOptics,
    sigma: &'r (Vec<Twiss>, Tunes),
}

/// The report, at the mean supplies of the recording; none of a result without optics.
///
/// # Errors
/// [`OrbitError`] where the design has no stable motion.
pub fn page(ring: &Ring, result: &FitResult) -> Result<Option<Page>, OrbitError> {
    let Some(fitted) = &result.calibrated else { return Ok(None) };
    let calibrated = Calibrated::of(ring, fitted, result)?;
    Ok(Some(Page {
        title: format!("{}: optics from {}", ring.name, result.recording),
        lead: calibrated.lead(),
        sections: vec![
            calibrated.tunes(),
            calibrated.beta_beat(),
            calibrated.phase(),
            calibrated.dispersion(),
            strengths(result),
            calibrated.monitors(),
        ],
    }))
}

impl<'r> Calibrated<'r> {
    fn of(ring: &'r Ring, fitted: &'r OpticsFunctions, result: &'r FitResult) -> Result<Self, OrbitError> {
        let (optics, sigma) = fitted;
        let design = Optics::of(ring, Hold::Momentum { delta: 0.0 })?;
        let design = (design.twiss()?, design.tunes()?);
        let s = ring.elements.iter().map(|element| element.s).chain([ring.circumference]).collect();
        Ok(Self { ring, result, s, design, optics, sigma })
    }

    fn lead(&self) -> String {
        let (tunes, sigma) = (self.optics.tunes, self.sigma.1);
        let beats = [0, 1].map(|plane| self.beats(plane).0);
        let rms = beats.map(|beat| (beat.iter().map(|b| b * b).sum::<f64>() / beat.len() as f64).sqrt());
        let off = self.result.throughout().map_or_else(String::new, |off| format!(" The design is {off}."));
        format!(
            "{} frames, method {}, chi2/dof {}. Tunes {:.4} ± {:.4} and {:.4} ± {:.4}; rms beta-beat {:.1} % in x and {:.1} % \
             in y against the design.{off}",
            self.result.frames,
            self.result.method,
            self.result.chi2(),
            tunes.x,
            sigma.x,
            tunes.y,
            sigma.y,
            100.0 * rms[0],
            100.0 * rms[1],
        )
    }

    fn tunes(&self) -> Section {
        let row = |plane: &str, of: fn(&Tunes) -> f64, measured: Option<TuneMeasured>| {
            let (design, tune, sigma) = (of(&self.design.1), of(&self.optics.tunes), of(&self.sigma.1));
            vec![
                plane.into(),
                format!("{design:.5}"),
                format!("{tune:.5} ± {sigma:.5}"),
                format!("{:+.5}", tune - design),
                measured.map_or("none".into(), |tune| format!("{:.5} ± {:.5}", tune.mean, tune.sigma)),
            ]
        };
        let header = ["plane", "design", "calibrated", "less design", "measured"].map(str::to_owned).to_vec();
        let caption = "Tunes with their integer part, calibrated ones at the recording's mean supply currents; errors are standard \
                       deviations."
            .into();
        let measured = self.result.tunes_measured;
        let rows = vec![row("x", |t| t.x, measured.x), row("y", |t| t.y, measured.y)];
        Section { heading: "Tunes".into(), tables: vec![Table { caption, header, rows }], ..Section::default() }
    }

    /// Beta-beat of a plane and its standard deviation [1].
    fn beats(&self, plane: usize) -> (Vec<f64>, Vec<f64>) {
        let all = self.optics.twiss.iter().zip(&self.design.0).zip(&self.sigma.0);
        all.map(|((twiss, design), sigma)| (twiss.beta_beat(design)[plane], sigma.beta[plane] / design.beta[plane]))
            .unzip()
    }

    fn beta_beat(&self) -> Section {
        let series = |plane: usize, name: &str| {
            let (beat, sigma) = self.beats(plane);
            self.series(name, beat.iter().map(|b| 100.0 * b), sigma.iter().map(|s| 100.0 * s))
        };
        let axes = Axes::new("Beta-beat", "path length [m]", "beta/beta of the design - 1 [%]");
        let figure = Figure::lines(&axes.compared(Reference::Level(0.0)), &[series(0, "x"), series(1, "y")]);
        section("Beta-beat", format!("Relative change of the beta functions. {BAND}"), figure)
    }

    fn phase(&self) -> Section {
        let series = |plane: usize, name: &str| {
            let all = self.optics.twiss.iter().zip(&self.design.0);
            let change = all.map(|(twiss, design)| (twiss.phase_advance[plane] - design.phase_advance[plane]) / TAU);
            self.series(name, change, self.sigma.0.iter().map(|sigma| sigma.phase_advance[plane] / TAU))
        };
        let axes = Axes::new("Phase advance from the start", "path length [m]", "calibrated less design [turns]");
        let figure = Figure::lines(&axes.compared(Reference::Level(0.0)), &[series(0, "x"), series(1, "y")]);
        section("Phase advance", format!("At the end of the ring it is the change of the tunes. {BAND}"), figure)
    }

    fn dispersion(&self) -> Section {
        let series = |plane: usize, name: &str| {
            let calibrated = self.optics.twiss.iter().map(|twiss| twiss.dispersion[plane]);
            self.series(name, calibrated, self.sigma.0.iter().map(|sigma| sigma.dispersion[plane]))
        };
        let design = |plane: usize| self.design.0.iter().map(move |twiss| twiss.dispersion[plane]);
        let mut all = vec![series(0, "x, calibrated"), Series::line("x, design", self.s.clone(), design(0).collect())];
        let vertical = |twiss: &Twiss| twiss.dispersion[1].abs() > 1e-9;
        if self.optics.twiss.iter().chain(&self.sigma.0).any(vertical) {
            all.extend([series(1, "y, calibrated"), Series::line("y, design", self.s.clone(), design(1).collect())]);
        }
        let figure = Figure::lines(&Axes::new("Dispersion", "path length [m]", "dispersion [m]"), &all);
        let mut section = section("Dispersion", "The change of the closed orbit with the momentum.".into(), figure);
        let change =
            self.optics.twiss.iter().zip(&self.design.0).map(|(t, design)| t.dispersion[0] - design.dispersion[0]);
        let change = self.series("x", change, self.sigma.0.iter().map(|sigma| sigma.dispersion[0]));
        let axes = Axes::new("Change of the dispersion", "path length [m]", "calibrated less design [m]");
        let figure = Figure::lines(&axes.compared(Reference::Level(0.0)), &[change]);
        section.figures.push((format!("The same against the design. {BAND}"), figure));
        section
    }

    fn series(&self, name: &str, values: impl Iterator<Item = f64>, sigma: impl Iterator<Item = f64>) -> Series {
        let values: Vec<f64> = values.collect();
        let band = values.iter().zip(sigma).map(|(value, sigma)| (value - sigma, value + sigma)).collect();
        Series::line(name, self.s.clone(), values).within(band)
    }

    /// All functions at the monitors that are read, in the plane of each.
    fn monitors(&self) -> Section {
        let row = |(monitor, name): (twin::Monitor, String)| {
            let (at, plane) = (monitor.element, monitor.plane.index());
            let (twiss, design, sigma) = (&self.optics.twiss[at], &self.design.0[at], &self.sigma.0[at]);
            let beat = [twiss.beta_beat(design)[plane], sigma.beta[plane] / design.beta[plane]].map(|b| 100.0 * b);
            vec![
                name,
                format!("{:.3}", self.s[at]),
                format!("{:.3} ± {:.3}", twiss.beta[plane], sigma.beta[plane]),
                format!("{:.2} ± {:.2}", beat[0], beat[1]),
                format!("{:.4} ± {:.4}", twiss.phase_advance[plane] / TAU, sigma.phase_advance[plane] / TAU),
                format!("{:.4} ± {:.4}", twiss.dispersion[plane], sigma.dispersion[plane]),
            ]
        };
        let header = ["monitor", "s [m]", "beta [m]", "beta-beat [%]", "phase advance [turns]", "dispersion [m]"];
        let table = Table {
            caption: "Calibrated optics at the monitors, in the plane of each; errors are standard deviations.".into(),
            header: header.map(str::to_owned).to_vec(),
            rows: self.ring.monitors_read().zip(self.ring.monitor_names()).map(row).collect(),
        };
        Section { heading: "Optics at the monitors".into(), tables: vec![table], ..Section::default() }
    }
}

fn section(heading: &str, caption: String, figure: Figure) -> Section {
    Section { heading: heading.into(), figures: vec![(caption, figure)], ..Section::default() }
}

/// The strength factors.
fn strengths(result: &FitResult) -> Section {
    let names: Vec<String> = result.vars.iter().map(|var| var.name.clone()).collect();
    let factors = Band {
        label: result.method.into(),
        centre: result.vars.iter().map(|var| var.mean).collect(),
        inner: result.vars.iter().map(|var| (var.q16, var.q84)).collect(),
        outer: result.vars.iter().map(|var| (var.q025, var.q975)).collect(),
    };
    let axes = Axes::new("Strength factors (vars)", "quadrupole", "factor on the design gradient [1]");
    let figure = Figure::bands(&axes.named(&names).compared(Reference::Level(1.0)), &[factors]);
    let text = "Means, 68 % and 95 % intervals. Optics follow from the means with the design's other magnets. They are known better than the \
                intervals say, which leave room for a design that is off.";
    section("Strengths", text.into(), figure)
}
