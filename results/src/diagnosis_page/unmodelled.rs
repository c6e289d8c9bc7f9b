//! The decisive picture of an unmodelled discrepancy: the residuals at its place.

use diagnosis::{Diagnosis, Discrepancy, FitError, Location, capitalised, steering};
use nalgebra::DVector;
use report::{Axes, Figure, Map, Reference, Series};
use twin::{Hold, Optics, Plane, Signatures};

use super::lattice::{STRIP, strip};
use super::partial::Partial;
use super::residuals::Residual;
use super::{slope, tunes};

/// Stretches of time.
const STRETCHES: usize = 8;

/// A sum of residuals by the inverse of their variance.
#[derive(Debug, Clone, Copy, Default)]
struct Mean {
    pull: f64,
    weight: f64,
}

impl Mean {
    /// One more value, in standard deviations, of what is `size` standard deviations per unit.
    fn add(&mut self, value: f64, size: f64) {
        self.pull += size * value;
        self.weight += size * size;
    }

    /// With another sum.
    fn and(self, other: Self) -> Self {
        Self { pull: self.pull + other.pull, weight: self.weight + other.weight }
    }

    fn value(self) -> f64 {
        self.pull / self.weight
    }

    fn bar(self) -> (f64, f64) {
        let sigma = self.weight.sqrt().recip();
        (self.value() - sigma, self.value() + sigma)
    }
}

/// Points with their error bars; those without readings are left out.
fn points(label: &str, all: impl Iterator<Item = (f64, Mean)>) -> Series {
    let all: Vec<(f64, Mean)> = all.filter(|(_, mean)| mean.weight > 0.0).collect();
    let (x, y) = all.iter().map(|(x, mean)| (*x, mean.value())).unzip();
    Series::points(label, x, y).within(all.iter().map(|(_, mean)| mean.bar()).collect())
}

/// What the figures are made of.
struct Left<'d> {
    diagnosis: &'d Diagnosis,
    partial: Partial<'d>,
    residuals: Vec<Residual>,
    /// What is wrong, as a title begins.
    what: String,
}

/// The figures of a place.
///
/// # Errors
/// [`FitError`].
pub fn figures(diagnosis: &Diagnosis, one: &Discrepancy) -> Result<Vec<(String, Figure)>, FitError> {
    let found = &diagnosis.found;
    let partial = Partial::beyond(&found.data, &found.best, &found.best.hypothesis.without_element())?;
    let residuals = Residual::all(partial.data, &partial.measured);
    let left = Left { diagnosis, what: one.at.phrase(&found.data), residuals, partial };
    Ok(match one.at {
        Location::Monitor(b) | Location::MonitorElsewhere(b) => vec![left.of_monitor(b)],
        Location::MonitorCurve(b) => vec![left.over_position(b)?],
        Location::MonitorInTime(b) => vec![left.in_time(b)],
        Location::GainInTime(b) => vec![left.gain_in_time(b)?],
        Location::Corrector(c) | Location::CorrectorElsewhere(c) => vec![left.of_corrector(c)],
        Location::Ring(q, plane) => vec![left.kicks(q, plane)?],
        Location::RingInTime(q, plane) => vec![left.kick_in_time(q, plane)?],
        Location::Linear(q, _) => {
            let mut figures = Vec::from_iter(left.of_element());
            figures.extend([left.kicks(q, Plane::X)?, left.kicks(q, Plane::Y)?]);
            figures
        }
        Location::QuadrupoleInTime(q) => {
            let mut figures = tunes::of_model(&found.data, &found.best, &left.title())?;
            figures.extend([left.kick_in_time(q, Plane::X)?, left.kick_in_time(q, Plane::Y)?]);
            figures
        }
        Location::QuadrupoleInRuns(q) => left.gradient(q)?,
        Location::Tunes => tunes::of_model(&found.data, &found.best, &left.title())?,
        Location::Time => vec![left.map_in_time()],
        // what passes within settings has a picture of its own; what noise has in common is in the table of imperfections
        Location::FirstFrames { .. } | Location::UnsteadyCorrector(_) => Vec::new(),
        Location::Everywhere | Location::FrameToFrame => Vec::new(),
    })
}

impl Left<'_> {
    /// What the unknown element of the model does.
    fn of_element(&self) -> Option<(String, Figure)> {
        let element = self.partial.fitted.hypothesis.element.as_ref();
        element.map(|_| slope::of_element(&self.what, &self.partial))
    }

    /// Of a quadrupole.
    fn label(&self, q: usize) -> &str {
        let ring = &self.partial.data.ring;
        ring.label(ring.quadrupoles[q].element)
    }

    fn name(&self, b: usize) -> String {
        self.partial.data.ring.monitor_names()[b].clone()
    }

    /// Residuals of a monitor, setting by setting.
    fn of_monitor(&self, b: usize) -> (String, Figure) {
        let data = self.partial.data;
        let driven = data.driven_correctors();
        let of_sign = |wanted: f64| {
            let mean = |c: usize| {
                let mut mean = Mean::default();
                let mine =
                    |one: &&Residual| one.monitor == b && one.kick.is_some_and(|(of, sign)| of == c && sign == wanted);
                self.residuals.iter().filter(mine).for_each(|one| mean.add(one.value, one.noise.recip()));
                mean
            };
            driven.iter().enumerate().map(move |(i, &c)| (i as f64, mean(c))).collect::<Vec<_>>()
        };
        let series = [("kick +", 1.0), ("kick \u{2212}", -1.0)]
            .map(|(label, sign)| points(label, of_sign(sign).into_iter().map(|(x, mean)| (x + 0.15 * sign, mean))));
        let names: Vec<String> = driven.iter().map(|&c| data.ring.corrector_names()[c].clone()).collect();
        let axes = Axes::new(
            &self.title(),
            "corrector that is powered",
            &format!("{}: measured less model [µm]", self.name(b)),
        );
        let caption = "Mean residual of the monitor at each setting, about its baseline, with the noise of the mean.";
        (caption.into(), Figure::lines(&axes.named(&names).compared(Reference::Level(0.0)), &series))
    }

    /// Residuals of a monitor over its predicted reading.
    fn over_position(&self, b: usize) -> Result<(String, Figure), FitError> {
        let positions = self.positions(b)?;
        let largest = positions.amax().max(f64::MIN_POSITIVE);
        let mut means = vec![(0.0, Mean::default()); 16];
        for one in self.residuals.iter().filter(|one| one.monitor == b) {
            let at = ((0.5 + 0.5 * positions[one.pool] / largest) * means.len() as f64) as usize;
            let group = at.min(means.len() - 1);
            means[group].0 += positions[one.pool] * one.noise.powi(-2);
            means[group].1.add(one.value, one.noise.recip());
        }
        let series = points("mean of readings", means.into_iter().map(|(sum, mean)| (sum / mean.weight, mean)));
        let axes =
            Axes::new(&self.title(), &format!("{}: predicted reading [mm]", self.name(b)), "measured less model [µm]");
        let caption =
            "Mean residual of the monitor over the position that the model predicts, with the noise of the mean.";
        Ok((caption.into(), Figure::lines(&axes.compared(Reference::Level(0.0)), &[series])))
    }

    /// Predicted readings of a monitor about their mean [mm].
    fn positions(&self, b: usize) -> Result<DVector<f64>, FitError> {
        let column = self.partial.fitted.predicted(self.partial.data, 0)?.column(b) * 1e3;
        Ok(column.add_scalar(-column.mean()))
    }

    fn in_time(&self, b: usize) -> (String, Figure) {
        let mut means = [Mean::default(); STRETCHES];
        let mine = self.residuals.iter().filter(|one| one.monitor == b);
        mine.for_each(|one| means[stretch(one.time)].add(one.value, one.noise.recip()));
        self.over_time(&means, &format!("{}: measured less model [µm]", self.name(b)), "Mean residual of the monitor")
    }

    fn gain_in_time(&self, b: usize) -> Result<(String, Figure), FitError> {
        let positions = self.positions(b)?;
        let mut means = [Mean::default(); STRETCHES];
        for one in self.residuals.iter().filter(|one| one.monitor == b) {
            // a gain that is 1 % too high reads so much more, in standard deviations
            means[stretch(one.time)].add(one.value, 0.01 * positions[one.pool] * 1e3 / one.noise);
        }
        Ok(self.over_time(
            &means,
            &format!("{}: error of the gain [%]", self.name(b)),
            "Gain that the monitor's residuals would give",
        ))
    }

    fn over_time(&self, means: &[Mean; STRETCHES], label: &str, what: &str) -> (String, Figure) {
        let middle = |i: usize| -1.0 + (2 * i + 1) as f64 / STRETCHES as f64;
        let series = points("stretch of the campaign", means.iter().enumerate().map(|(i, mean)| (middle(i), *mean)));
        let axes = Axes::new(&self.title(), "time, −1 at the start to 1 at the end [1]", label);
        let caption = format!("{what} in {STRETCHES} stretches of the campaign, with the noise of the mean.");
        (caption, Figure::lines(&axes.compared(Reference::Level(0.0)), &[series]))
    }

    /// Residuals of all monitors while a corrector is powered, along the beam.
    fn of_corrector(&self, c: usize) -> (String, Figure) {
        let data = self.partial.data;
        let of_plane = |label: &str, plane: Plane| {
            let of = |b: usize| {
                let mut mean = Mean::default();
                for one in self.residuals.iter().filter(|one| one.monitor == b) {
                    if let Some((_, sign)) = one.kick.filter(|(of, _)| *of == c) {
                        mean.add(sign * one.value, one.noise.recip());
                    }
                }
                mean
            };
            let monitors: Vec<_> =
                data.ring.monitors_read().enumerate().filter(|(_, monitor)| monitor.plane == plane).collect();
            points(label, monitors.into_iter().map(|(b, monitor)| (data.ring.elements[monitor.element].s, of(b))))
        };
        let series = [of_plane("horizontal monitors", Plane::X), of_plane("vertical monitors", Plane::Y)];
        let axes = Axes::new(&self.title(), "s [m]", "residual, sign of the kick [µm]");
        let caption = format!(
            "Mean residual of every monitor while {} is powered, times the sign of its kick, with the noise of the mean. {STRIP}",
            data.ring.corrector_names()[c]
        );
        let axes = axes.compared(Reference::Level(0.0)).along(strip(self.diagnosis));
        (caption, Figure::lines(&axes, &series))
    }

    /// The kick at a quadrupole that each setting's residuals would give.
    fn kicks(&self, q: usize, plane: Plane) -> Result<(String, Figure), FitError> {
        let response = self.response_to(q, plane)?;
        let mut runs = self.no_means();
        // um per urad
        self.residuals.iter().for_each(|one| runs[one.pool].add(one.value, response[one.monitor] / one.noise));
        let label = self.label(q);
        let figure = self.in_settings(&format!("{} kick near {label} [µrad]", direction(plane)), &runs);
        let caption = format!(
            "The kick at {label} that describes the residuals of each setting best, the vars held, with its error from the noise. A gradient there \
             kicks in proportion to the orbit that each corrector makes."
        );
        Ok((caption, figure))
    }

    /// The change of a quadrupole's gradient that the residuals of each setting, and of each run of frames, would give.
    fn gradient(&self, q: usize) -> Result<Vec<(String, Figure)>, FitError> {
        let (data, fitted) = (self.partial.data, self.partial.fitted);
        let (machine, drives) = fitted.machine_on_orbit(data, 0)?;
        let signatures = Signatures::of(&machine, &drives)?;
        // of one per cent
        let does = steering(&signatures, machine.ring(), &drives.orbit).swap_remove(q) * 0.01;
        let mut runs = self.no_means();
        for one in &self.residuals {
            runs[one.pool].add(one.value, 1e6 * does.readings[(one.pool, one.monitor)] / one.noise);
        }
        let miss = data.miss(&fitted.predicted(data, 0)?);
        for (plane, noise) in [0, 1].into_iter().filter_map(|plane| Some((plane, data.tune_noise(plane)?))) {
            for (run, readings) in data.tune_pools(plane) {
                let sigma = noise / readings.sqrt();
                runs[run].add(miss[(run, data.monitors() + plane)] / sigma, does.tune(plane, run) / sigma);
            }
        }
        let label = self.label(q);
        let axis = format!("change of the gradient of {label} [%]");
        let in_settings = self.in_settings(&axis, &runs);
        let in_time = points("run of frames", data.drives.time.iter().copied().zip(runs));
        let axes = Axes::new(&self.title(), "time, \u{2212}1 at the start to 1 at the end [1]", &axis);
        let in_time = Figure::lines(&axes.compared(Reference::Level(0.0)), &[in_time]);
        let what = |of: &str| {
            format!(
                "The change of the gradient of {label} that describes the readings of all monitors and the tunes of {of} best, the vars held, with its \
                 error from the noise."
            )
        };
        Ok(vec![(what("each setting"), in_settings), (what("each run of frames"), in_time)])
    }

    fn no_means(&self) -> Vec<Mean> {
        vec![Mean::default(); self.partial.data.pools.count]
    }

    /// The mean of each setting, from those of runs of frames.
    fn in_settings(&self, axis: &str, runs: &[Mean]) -> Figure {
        let data = self.partial.data;
        let (driven, settings) = (data.driven_correctors(), &data.settings);
        let of_sign = |wanted: f64| {
            let mut means = vec![Mean::default(); driven.len()];
            for (run, mean) in runs.iter().enumerate() {
                let Some((c, _)) = settings.kick(run).filter(|(_, sign)| *sign == wanted) else { continue };
                let Some(at) = driven.iter().position(|&of| of == c) else { continue };
                means[at] = means[at].and(*mean);
            }
            means
        };
        let series = [("kick +", 1.0), ("kick \u{2212}", -1.0)].map(|(label, sign)| {
            points(label, of_sign(sign).into_iter().enumerate().map(|(i, mean)| (i as f64 + 0.15 * sign, mean)))
        });
        let names: Vec<String> = driven.iter().map(|&c| data.ring.corrector_names()[c].clone()).collect();
        let axes = Axes::new(&self.title(), "corrector that is powered", axis);
        Figure::lines(&axes.named(&names).compared(Reference::Level(0.0)), &series)
    }

    /// The kick at a quadrupole that the residuals of each stretch of time would give.
    fn kick_in_time(&self, q: usize, plane: Plane) -> Result<(String, Figure), FitError> {
        let response = self.response_to(q, plane)?;
        let mut means = [Mean::default(); STRETCHES];
        for one in &self.residuals {
            means[stretch(one.time)].add(one.value, response[one.monitor] / one.noise);
        }
        let axis = format!("{} kick near {} [µrad]", direction(plane), self.label(q));
        Ok(self.over_time(&means, &axis, "The kick that describes the residuals of all monitors best, the vars held,"))
    }

    /// Response of the read monitors to a kick at a quadrupole [m/rad].
    fn response_to(&self, q: usize, plane: Plane) -> Result<DVector<f64>, FitError> {
        let (data, fitted) = (self.partial.data, self.partial.fitted);
        let (machine, _) = fitted.machine(data, 0)?;
        let optics = Optics::of(machine.ring(), Hold::Momentum { delta: 0.0 })?;
        let direction = if plane == Plane::X { [1.0, 0.0] } else { [0.0, 1.0] };
        let source = optics.kick(data.ring.quadrupoles[q].element, direction);
        Ok(optics.response(&optics.read_monitors(), &[source]).column(0).into_owned())
    }

    /// Mean residuals of all monitors in stretches of time.
    fn map_in_time(&self) -> (String, Figure) {
        let data = self.partial.data;
        let monitors = data.active_monitors();
        let names = data.ring.monitor_names();
        let rows: Vec<String> = monitors.iter().map(|&b| names[b].clone()).collect();
        let columns: Vec<String> = (1..=STRETCHES).map(|i| format!("{i}/{STRETCHES}")).collect();
        let values = nalgebra::DMatrix::from_fn(rows.len(), STRETCHES, |row, column| {
            let mine = |one: &&Residual| one.monitor == monitors[row] && stretch(one.time) == column;
            let (sum, count) =
                self.residuals.iter().filter(mine).fold((0.0, 0.0), |(s, n), one| (s + one.value, n + 1.0));
            if count > 0.0 { sum / f64::sqrt(count) } else { f64::NAN }
        });
        let limit = values
            .iter()
            .copied()
            .filter(|value| !value.is_nan())
            .fold(4.0, |most: f64, v: f64| most.max(v.abs()))
            .min(12.0)
            .ceil();
        let axes = Axes::new(&self.title(), "stretch of the campaign", "monitor").named(&columns);
        let map = Map { name: "mean residual".into(), values };
        let caption = "Mean residual of every monitor in stretches of the campaign, in units of its error.";
        (caption.into(), Figure::maps(&axes, "mean residual [its standard deviation]", limit, &rows, &[map]))
    }

    fn title(&self) -> String {
        capitalised(&self.what)
    }
}

fn direction(plane: Plane) -> &'static str {
    if plane == Plane::X { "horizontal" } else { "vertical" }
}

fn stretch(time: f64) -> usize {
    ((0.5 * (time + 1.0) * STRETCHES as f64) as usize).min(STRETCHES - 1)
}
