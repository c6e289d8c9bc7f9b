//! Wiring and units, before any physics: whether the columns of a recording are what its header says.
//!
//! The measured response, least squares of each monitor's readings on all kicks and the RF offset, is compared with that of the
//! design under each wiring `w`: planes exchanged, signs reversed, units or scales wrong, columns shifted, readings of another frame. With `M_w` the measured
//! response as it would be if the columns were put right, in units of the design's rms response (each plane for itself),
//!
//! `d_w^2 = mean square of (M_w - R)`,   `ln L(w) = -(v + n)/2 ln(1 + n d_w^2/(v s^2)) - n ln(scale_w)`,
//!
//! a Student distribution: `s` is what the priors of the vars scatter the design's response by, known to a factor or so (`v` degrees of
//! freedom), and `n` is the number of independent errors that a response can have, two of each instrument (beta function and phase). Readings that
//! are taken for those of another frame leave another residual `q`, noise unknown, so that `-N/2 ln(q_w/q)` is added for each monitor. `R`
//! is the design at the tunes that suit the wiring best, and with what may be held, since a machine may be run in another way. A response with a single reversed, dead or exchanged
//! instrument resembles the design more than any other wiring: those are effects (`bpm_polarity`, `bpm_dead`, `bpm_swap`, and those of correctors).
//!
//! Source: A. Gelman et al., Bayesian Data Analysis (2013), sec. 3.2, for the Student distribution of an unknown scatter.

use core::fmt;

use evidence::{Factor, gram};
use nalgebra::{DMatrix, DMatrixView, DVector, Matrix2, Vector2};
use twin::{EffectError, Hold, Machine, Optics, OrbitError, Plane, Rf, Ring};

use super::columns::beside;
use inference::recording::Recording;
use inference::{Drive, Prior};

/// Prior probability that all columns are as the header says.
const AS_STATED: f64 = 0.9;
/// Probability of a wrong wiring above which a recording is refused.
const REFUSED: f64 = 0.95;
/// Least correlation of a response that is put right with the design's: 0.8 and more with vars that scatter, 0 where there is only noise,
/// as in columns of correctors that were never set.
const RESEMBLES: f64 = 0.5;
/// Degrees of freedom of the scatter: known to a factor of two.
const FREEDOM: f64 = 4.0;
/// Relative error of a response that ordinary gains, rolls and what is held make beside the vars.
const ORDINARY: f64 = 0.1;
/// Distances of the tunes from the design's that are tried, how often the step is halved about the best, and the prior standard deviation.
const STEP: f64 = 0.06;
const STEPS: i32 = 7;
const ROUNDS: i32 = 4;
const USUAL: f64 = 0.15;
/// Columns that a table may be shifted by.
const SHIFTS: [isize; 6] = [1, -1, 2, -2, 3, -3];
/// Frames by which the readings may lie behind the kicks: a counter that begins at the other end of the cycle.
const LATE: [isize; 2] = [1, -1];
/// Factors by which kicks or readings may be off: mm for m, mrad for rad.
const UNITS: [f64; 2] = [1e3, 1e-3];
/// Factors by which all kicks may be off: amplitude for peak to peak, one pole for two.
const SCALES: [f64; 2] = [2.0, 0.5];

/// Some columns of the recording.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Columns {
    /// Of the monitors of one plane, or of both.
    Readings(Option<Plane>),
    /// Of the correctors of one plane, or of both.
    Kicks(Option<Plane>),
}

/// What may be wrong with them.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Fault {
    /// Each instrument acts in the other plane, at its own place.
    Exchanged,
    /// The sign is wrong.
    Reversed,
    /// They are this many times too large.
    Scaled(f64),
    /// Each stands this many columns further right than its name, the last ones first.
    Shifted(isize),
    /// Each row holds those of the frame this many before.
    Late(isize),
}

/// A wrong wiring, and how likely it is.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Wiring {
    /// The columns.
    pub columns: Columns,
    /// What is wrong.
    pub fault: Fault,
    /// Posterior probability.
    pub probability: f64,
    /// Correlation of the measured response of these columns with the design's, as stated and put right.
    pub correlation: [f64; 2],
}

/// A recording whose columns are not what its header says: the likely wirings, most likely first.
#[derive(Debug, Clone, PartialEq)]
pub struct Miswired(Vec<Wiring>);

/// Responses of the design, rows read monitors, columns correctors and, last, the RF offset.
struct Designs<'m> {
    /// The design, by what it may hold; first as the header says.
    machines: &'m [Machine],
    /// Relative change of each quadrupole's gradient that moves both tunes by 1.
    by_family: Vec<f64>,
    /// By whether the monitors, and whether the correctors, act in the other plane.
    at: Vec<[[DMatrix<f64>; 2]; 2]>,
    /// Distance of the tunes from the design's, of each.
    off: Vec<f64>,
}

/// The measured response and the scale of the design's.
struct Measured<'r> {
    ring: &'r Ring,
    /// As [`Designs`].
    response: DMatrix<f64>,
    /// The same, were each row's readings those of the frame before, or of that after, and `ln` likelihood of the readings about it relative to that
    /// about the stated one.
    late: [(DMatrix<f64>, f64); 2],
    /// Variance of its noise.
    variance: DMatrix<f64>,
    /// Rms of the design's response of each plane [m/rad], and of its dispersive orbit in x [m].
    scale: [f64; 3],
    /// Mean square scatter relative to these.
    scatter: f64,
}

impl Miswired {
    /// The wirings that a recording has more likely than that of its header, if any.
    ///
    /// # Errors
    /// [`EffectError`] if the ring as designed has no orbit.
    pub fn find(ring: &Ring, recording: &Recording) -> Result<Option<Self>, EffectError> {
        let ring = &*recording.powered(ring);
        let machines = machines(ring, recording)?;
        let mut designs = Designs::from_machines(&machines)?;
        let measured = Measured::from_recording(ring, recording, designs.stated());
        // what looks right on the design itself needs no other tunes
        if measured.judged(&designs).is_none() {
            return Ok(None);
        }
        designs.at_other_tunes(&measured);
        Ok(measured.judged(&designs))
    }
}

/// Every wrong wiring.
fn wirings() -> Vec<(Columns, Fault)> {
    let mut all = Vec::new();
    for plane in [Some(Plane::X), Some(Plane::Y), None] {
        let both = [Columns::Readings(plane), Columns::Kicks(plane)];
        for columns in both {
            all.push((columns, Fault::Reversed));
            all.extend(SHIFTS.map(|shift| (columns, Fault::Shifted(shift))));
        }
        all.extend(UNITS.map(|factor| both.map(|columns| (columns, Fault::Scaled(factor)))).concat());
    }
    all.extend(SCALES.map(|factor| (Columns::Kicks(None), Fault::Scaled(factor))));
    all.extend([Columns::Readings(None), Columns::Kicks(None)].map(|columns| (columns, Fault::Exchanged)));
    all.extend(LATE.map(|by| (Columns::Readings(None), Fault::Late(by))));
    all
}

impl<'m> Designs<'m> {
    /// As the header says.
    fn from_machines(machines: &'m [Machine]) -> Result<Self, OrbitError> {
        let ring = machines[0].ring();
        let by_family = families(ring)?;
        Ok(Self { machines, by_family, at: vec![responses(&machines[0], ring)?], off: vec![0.0] })
    }

    /// And at other tunes, close together where those suit the header's wiring best: towards an integer the response grows without limit.
    fn at_other_tunes(&mut self, measured: &Measured) {
        for step in -STEPS..=STEPS {
            self.add(STEP * f64::from(step));
        }
        for round in 1..=ROUNDS {
            let best = measured.best(self, None).1.map(|i| self.off[i]);
            for off in best {
                [-1.0, 1.0].into_iter().for_each(|side| self.add(off + side * STEP * 0.5_f64.powi(round)));
            }
        }
    }

    /// With both tunes moved; at an integer there is no response.
    fn add(&mut self, off: f64) {
        let factors: Vec<f64> = self.by_family.iter().map(|slope| 1.0 + slope * off).collect();
        let ring = self.machines[0].ring().with_strengths(&factors);
        for responses in self.machines.iter().filter_map(|machine| responses(machine, &ring).ok()) {
            self.at.push(responses);
            self.off.push(off);
        }
    }

    /// `ln` prior of the tune of one plane.
    fn log_prior(&self, i: usize) -> f64 {
        -0.5 * (self.off[i] / USUAL).powi(2)
    }

    /// Of the header's wiring, on the design.
    fn stated(&self) -> &DMatrix<f64> {
        &self.at[0][0][0]
    }
}

/// The ring with what the header believes to be held, and with what else may be.
fn machines(ring: &Ring, recording: &Recording) -> Result<Vec<Machine>, EffectError> {
    let held = [recording.header.believed(ring)?, Rf::FixedMomentum.into(), Rf::FixedFrequency.into()];
    let radial_loop = recording.header.radial_loop(ring).and_then(Result::ok);
    let known = held.into_iter().map(|holding| Machine::new(ring.clone(), holding, &[]));
    let unknown = radial_loop.map(|effect| Machine::new(ring.clone(), Rf::FixedMomentum, &[effect]));
    known.chain(unknown).collect()
}

/// Relative change of each quadrupole's gradient that moves both tunes by 1, to first order: one factor for the focusing ones and one for
/// the others [M].
fn families(ring: &Ring) -> Result<Vec<f64>, OrbitError> {
    let optics = Optics::of(ring, Hold::Momentum { delta: 0.0 })?;
    let mut slopes = Matrix2::zeros();
    let gradients = ring.gradients();
    for (gradient, k1) in optics.quadrupoles().iter().zip(&gradients) {
        let [x, y] = optics.tune_slope(gradient);
        let mut column = slopes.column_mut(usize::from(*k1 < 0.0));
        column += Vector2::new(x, y) * *k1;
    }
    let both = slopes.try_inverse().map_or_else(Vector2::zeros, |inverse| inverse * Vector2::repeat(1.0));
    Ok(gradients.iter().map(|k1| both[usize::from(*k1 < 0.0)]).collect())
}

/// Responses by whether the monitors, and whether the correctors, act in the other plane.
fn responses(machine: &Machine, ring: &Ring) -> Result<[[DMatrix<f64>; 2]; 2], OrbitError> {
    let optics = Optics::of(ring, Hold::Momentum { delta: 0.0 })?;
    let held = machine.held_of(ring, &optics)?;
    let turned = |plane: Plane, other: bool| match (plane, other) {
        (Plane::X, false) | (Plane::Y, true) => Plane::X,
        _ => Plane::Y,
    };
    let observers = [false, true].map(|other| -> Vec<_> {
        ring.monitors_read().map(|monitor| optics.observe(monitor.element, turned(monitor.plane, other))).collect()
    });
    let sources = [false, true].map(|other| -> Vec<_> {
        let direction = |plane| if plane == Plane::X { [1.0, 0.0] } else { [0.0, 1.0] };
        ring.correctors.iter().map(|one| optics.kick(one.element, direction(turned(one.plane, other)))).collect()
    });
    Ok(observers.each_ref().map(|observers| {
        // as if a loop were open for the steps
        let rf = optics.dispersion_of(observers) / -optics.slip_factor();
        sources.each_ref().map(|sources| beside(held.response(&optics, observers, sources), &rf))
    }))
}

impl<'r> Measured<'r> {
    fn from_recording(ring: &'r Ring, recording: &Recording, design: &DMatrix<f64>) -> Self {
        let (split, kicks) = (ring.horizontal_monitors(), design.ncols() - 1);
        let rms = |part: DMatrixView<f64>| (part.norm_squared() / part.len().max(1) as f64).sqrt();
        let horizontal = ring.horizontal_correctors();
        let scale = [
            rms(design.view((0, 0), (split, horizontal))),
            rms(design.view((split, horizontal), (design.nrows() - split, kicks - horizontal))),
            rms(design.view((0, kicks), (split, 1))),
        ];
        let rows = recording.rows.iter().map(|row| {
            let Drive { kick, rf_offset, .. } = Drive::from_row(&recording.header, row);
            kick.push(rf_offset).transpose()
        });
        let drive = DMatrix::from_rows(&rows.collect::<Vec<_>>());
        let regressed = |by: isize| -> Vec<Regressed> {
            (0..design.nrows())
                .map(|b| Regressed::from_recording(recording, &drive, by, b, &prior(ring, scale, b)))
                .collect()
        };
        let rows = |of: &[Regressed], row: fn(&Regressed) -> &DVector<f64>| {
            DMatrix::from_columns(&of.iter().map(|one| row(one).clone()).collect::<Vec<_>>()).transpose()
        };
        let stated = regressed(0);
        let late = LATE.map(|by| {
            let late = regressed(by);
            let log_likelihood = stated.iter().zip(&late).map(|(stated, late)| late.log_likelihood(stated)).sum();
            (rows(&late, |one| &one.response), log_likelihood)
        });
        let response = rows(&stated, |one| &one.response);
        let variance = rows(&stated, |one| &one.variance);
        let scatter = ORDINARY.powi(2) + of_vars(ring, &Prior::from_ring(ring), design);
        Self { ring, response, late, variance, scale, scatter }
    }

    /// Columns of the monitors and of the correctors that a wiring concerns.
    fn range(&self, columns: Columns) -> core::ops::Range<usize> {
        let (first, all, plane) = match columns {
            Columns::Readings(plane) => (self.ring.horizontal_monitors(), self.ring.read_monitors.len(), plane),
            Columns::Kicks(plane) => (self.ring.horizontal_correctors(), self.ring.correctors.len(), plane),
        };
        match plane {
            Some(Plane::X) => 0..first,
            Some(Plane::Y) => first..all,
            None => 0..all,
        }
    }

    /// The response as it is with readings of another frame, and `ln` likelihood of these.
    fn late(&self, fault: Fault) -> Option<&(DMatrix<f64>, f64)> {
        LATE.iter().position(|by| fault == Fault::Late(*by)).map(|i| &self.late[i])
    }

    /// The measured response with the columns put right, and `ln` of the change of its unit.
    fn put_right(&self, wiring: Option<(Columns, Fault)>) -> (DMatrix<f64>, f64) {
        let Some((columns, fault)) = wiring else { return (self.response.clone(), 0.0) };
        let range = self.range(columns);
        let of_readings = matches!(columns, Columns::Readings(_));
        let factor = match (fault, of_readings) {
            (Fault::Reversed, _) => -1.0,
            (Fault::Scaled(factor), true) => 1.0 / factor,
            // what is too large is divided by
            (Fault::Scaled(factor), false) => factor,
            _ => 1.0,
        };
        let from = |i: usize| match fault {
            Fault::Shifted(by) => {
                range.start + ((i - range.start) as isize + by).rem_euclid(range.len() as isize) as usize
            }
            _ => i,
        };
        // rows those of the columns, monitors or correctors
        let turned = |response: &DMatrix<f64>| if of_readings { response.clone() } else { response.transpose() };
        let stated = turned(self.late(fault).map_or(&self.response, |(late, _)| late));
        let mut right = stated.clone();
        range.clone().for_each(|i| right.set_row(i, &(stated.row(from(i)) * factor)));
        let share = range.len() as f64 / stated.nrows() as f64;
        (turned(&right), factor.abs().ln() * share)
    }

    /// The design that a wiring is compared with.
    fn design(designs: &[[DMatrix<f64>; 2]; 2], wiring: Option<(Columns, Fault)>) -> &DMatrix<f64> {
        match wiring {
            Some((Columns::Readings(_), Fault::Exchanged)) => &designs[1][0],
            Some((Columns::Kicks(_), Fault::Exchanged)) => &designs[0][1],
            _ => &designs[0][0],
        }
    }

    /// The wirings that are more likely than that of the header, if any.
    fn judged(&self, designs: &Designs) -> Option<Miswired> {
        let wrong = wirings();
        let stated = self.best(designs, None).0 + AS_STATED.ln();
        let prior = ((1.0 - AS_STATED) / wrong.len() as f64).ln();
        let weights: Vec<f64> = wrong.iter().map(|one| self.best(designs, Some(*one)).0 + prior).collect();
        let largest = weights.iter().copied().fold(stated, f64::max);
        let sum = weights.iter().map(|weight| (weight - largest).exp()).sum::<f64>() + (stated - largest).exp();
        let wiring = |(&(columns, fault), weight): (&(Columns, Fault), &f64)| Wiring {
            columns,
            fault,
            probability: (weight - largest).exp() / sum,
            correlation: self.correlation(designs, columns, fault),
        };
        let mut likely: Vec<Wiring> = wrong.iter().zip(&weights).map(wiring).collect();
        likely.sort_by(|one, other| other.probability.total_cmp(&one.probability));
        likely.retain(|one| one.probability > 1.0 - REFUSED && one.correlation[1] > RESEMBLES);
        let refused = (stated - largest).exp() / sum < 1.0 - REFUSED;
        (refused && !likely.is_empty()).then_some(Miswired(likely))
    }

    /// `ln` likelihood of a wiring, that of the header if none, at the tunes that suit it best, and the designs of these in x and y.
    fn best(&self, designs: &Designs, wiring: Option<(Columns, Fault)>) -> (f64, [usize; 2]) {
        let (response, log_scale) = self.put_right(wiring);
        let n = 2.0 * (response.nrows() + response.ncols()) as f64;
        let of_readings = wiring.and_then(|(_, fault)| self.late(fault)).map_or(0.0, |(_, of_readings)| *of_readings);
        let off: Vec<[f64; 2]> = designs.at.iter().map(|at| self.off(&response, Self::design(at, wiring))).collect();
        // the orbit in a plane is that of its own tune
        let pairs = (0..off.len()).flat_map(|x| (0..off.len()).map(move |y| [x, y]));
        let judged = |at: [usize; 2]| {
            let spread = n * (off[at[0]][0] + off[at[1]][1]) / (FREEDOM * self.scatter);
            let prior: f64 = at.iter().map(|&i| designs.log_prior(i)).sum();
            (prior - 0.5 * (FREEDOM + n) * spread.ln_1p() + n * log_scale + of_readings, at)
        };
        pairs.map(judged).max_by(|(one, _), (other, _)| one.total_cmp(other)).expect("at least the design")
    }

    /// Square of the difference in units of the design's rms, of the monitors in x and of those in y, over the weight of all: each number
    /// counts as well as it is measured.
    fn off(&self, response: &DMatrix<f64>, design: &DMatrix<f64>) -> [f64; 2] {
        let (mut off, mut weights) = ([0.0; 2], 0.0);
        for b in 0..response.nrows() {
            let plane = usize::from(b >= self.ring.horizontal_monitors());
            let unit = prior(self.ring, self.scale, b);
            for c in 0..response.ncols() {
                let unit = unit[c].powi(2);
                // the prior's width is what an idle corrector leaves
                let unknown = (self.variance[(b, c)] / unit).min(1.0);
                let weight = (1.0 - unknown) / (1.0 - unknown + unknown / self.scatter);
                off[plane] += weight * (response[(b, c)] - design[(b, c)]).powi(2) / unit;
                weights += weight;
            }
        }
        off.map(|off| off / weights)
    }

    /// Correlation of the measured response with the design's in the columns that a wiring concerns, as stated and put right.
    fn correlation(&self, designs: &Designs, columns: Columns, fault: Fault) -> [f64; 2] {
        let of_readings = matches!(columns, Columns::Readings(_));
        let range = self.range(columns);
        let part = |matrix: &DMatrix<f64>| {
            if of_readings {
                matrix.rows_range(range.clone()).into_owned()
            } else {
                matrix.columns_range(range.clone()).into_owned()
            }
        };
        let between = |response: &DMatrix<f64>, design: &DMatrix<f64>| {
            let (response, design) = (part(response), part(design));
            response.dot(&design) / (response.norm() * design.norm())
        };
        let wiring = Some((columns, fault));
        let right = Self::design(&designs.at[0], wiring);
        [between(&self.response, designs.stated()), between(&self.put_right(wiring).0, right)]
    }
}

/// Rms of the design's response in the plane of a monitor, of each column [m/rad], of the last [m].
fn prior(ring: &Ring, scale: [f64; 3], b: usize) -> DVector<f64> {
    let plane = usize::from(b >= ring.horizontal_monitors());
    DVector::from_element(ring.correctors.len(), scale[plane]).push(scale[2])
}

/// What a monitor's readings say of the response.
struct Regressed {
    response: DVector<f64>,
    variance: DVector<f64>,
    /// Number of readings, and the square of what is left of them, in units of the noise.
    readings: f64,
    left: f64,
}

impl Regressed {
    /// Least squares on what drove the beam in the frame so many before, and a baseline, with the prior's widths.
    fn from_recording(recording: &Recording, drive: &DMatrix<f64>, by: isize, b: usize, prior: &DVector<f64>) -> Self {
        let frame = |i: usize| i.checked_add_signed(-by).filter(|frame| *frame < drive.nrows());
        let read = recording.rows.iter().enumerate().filter_map(|(i, row)| Some((frame(i)?, row.reading[b]?)));
        let (frames, readings): (Vec<usize>, Vec<f64>) = read.unzip();
        let square = prior.component_mul(prior);
        if frames.is_empty() {
            return Self { response: DVector::zeros(prior.len()), variance: square, readings: 0.0, left: 0.0 };
        }
        let mut columns = drive.select_rows(&frames);
        columns.column_iter_mut().for_each(|mut column| column.add_scalar_mut(-column.mean()));
        let noise = recording.header.noise[b];
        columns.column_iter_mut().zip(prior.iter()).for_each(|(mut column, prior)| column *= prior / noise);
        let readings = DVector::from_vec(readings) / noise;
        let readings = readings.add_scalar(-readings.mean());
        let normal = gram(&columns) + DMatrix::identity(drive.ncols(), drive.ncols());
        let factor = Factor::of(normal).expect("at least 1 everywhere");
        let found = factor.solve(&columns.tr_mul(&readings));
        Self {
            response: found.component_mul(prior),
            variance: DVector::from_vec(factor.inverse_diagonal()).component_mul(&square),
            readings: readings.len() as f64,
            left: (&readings - columns * found).norm_squared(),
        }
    }

    /// `ln` likelihood relative to that of others, the noise unknown.
    fn log_likelihood(&self, other: &Self) -> f64 {
        let mean = |one: &Self| one.left.max(f64::MIN_POSITIVE) / one.readings.max(1.0);
        -0.5 * self.readings.min(other.readings) * (mean(self) / mean(other)).ln()
    }
}

/// Mean square relative change of the design's response by vars that scatter as their priors.
fn of_vars(ring: &Ring, prior: &Prior, design: &DMatrix<f64>) -> f64 {
    let Ok(optics) = Optics::of(ring, Hold::Momentum { delta: 0.0 }) else { return 0.0 };
    let (observers, sources, gradients) = (optics.read_monitors(), optics.correctors(), optics.quadrupoles());
    let slopes = optics.response_jacobian(&observers, &sources, &gradients);
    let mut scaled = slopes.into_iter().zip(ring.gradients()).map(|(slope, k1)| slope * k1);
    let mut by_param = vec![DMatrix::zeros(observers.len(), sources.len()); ring.parameters.len()];
    for quadrupole in &ring.quadrupoles {
        let slope = scaled.next().expect("one for each quadrupole");
        if let Some(param) = quadrupole.parameter {
            by_param[param] += slope;
        }
    }
    let variance = |(slope, precision): (&DMatrix<f64>, &f64)| slope.norm_squared() / precision;
    let scattered: f64 = by_param.iter().zip(prior.precision.iter()).map(variance).sum();
    // larger ones say no more than that nothing is known
    (scattered / design.columns(0, sources.len()).norm_squared()).min(1.0)
}

impl Columns {
    fn words(self) -> &'static str {
        match self {
            Self::Readings(Some(Plane::X)) => "the readings of plane x",
            Self::Readings(Some(Plane::Y)) => "the readings of plane y",
            Self::Readings(None) => "all readings",
            Self::Kicks(Some(Plane::X)) => "the kicks of the horizontal correctors",
            Self::Kicks(Some(Plane::Y)) => "the kicks of the vertical correctors",
            Self::Kicks(None) => "all kicks",
        }
    }

    fn names(self) -> &'static str {
        match self {
            Self::Readings(Some(Plane::X)) => "the columns x_...",
            Self::Readings(Some(Plane::Y)) => "the columns y_...",
            Self::Readings(None) => "the columns x_... and y_...",
            Self::Kicks(_) => "their columns ic_...",
        }
    }

    /// Where a factor can be changed.
    fn factors(self) -> String {
        match self {
            Self::Readings(_) => self.names().into(),
            Self::Kicks(_) => format!("kick_mrad_per_A in the header, or {}", self.names()),
        }
    }
}

impl fmt::Display for Wiring {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let (what, names, factors) = (self.columns.words(), self.columns.names(), self.columns.factors());
        match self.fault {
            Fault::Exchanged if self.columns == Columns::Readings(None) => {
                write!(f, "the planes of all monitors look exchanged: each reads the other plane at its place")
            }
            Fault::Exchanged => write!(f, "the planes of all correctors look exchanged: each kicks in the other plane"),
            Fault::Reversed => write!(f, "{what} look reversed: change the sign of {factors}"),
            Fault::Scaled(factor) if factor < 1.0 => {
                write!(f, "{what} look {} times too small: multiply {factors} by it", 1.0 / factor)
            }
            Fault::Scaled(factor) => write!(f, "{what} look {factor} times too large: divide {factors} by it"),
            Fault::Late(by) => {
                let other = if by > 0 { "before" } else { "after" };
                write!(f, "{what} look like those of the frame {other}: move {names} by one row against the others")
            }
            Fault::Shifted(by) => {
                let way = if by > 0 { "right" } else { "left" };
                write!(
                    f,
                    "{what} look shifted {way} by {} column{}: rename {names}",
                    by.abs(),
                    if by.abs() > 1 { "s" } else { "" }
                )
            }
        }?;
        let [stated, right] = self.correlation;
        write!(
            f,
            " (P = {:.3}; correlation with the design's response {stated:.2} as it is, {right:.2} put right)",
            self.probability
        )
    }
}

impl fmt::Display for Miswired {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.iter().enumerate().try_for_each(|(i, one)| write!(f, "{}{one}", if i > 0 { "; or " } else { "" }))
    }
}

#[cfg(test)]
mod tests {
    use std::path::{Path, PathBuf};

    use super::*;
    use inference::simulate::{self, Hardware, Truth};
    use twin::{Effect, EffectKind};

    fn folder() -> PathBuf {
        Path::new(env!("CARGO_MANIFEST_DIR")).join("../recordings")
    }

    fn judge(ring: &Ring, recording: &Recording) -> Option<Miswired> {
        Miswired::find(ring, recording).unwrap()
    }

    fn booster(name: &str) -> (Ring, Recording) {
        let at = folder().join(name);
        let ring = Recording::built_in_ring(&at).unwrap();
        let recording = Recording::read(&at, &ring).unwrap();
        (ring, recording)
    }

    #[test]
    #[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
    fn recordings_as_they_are_raise_no_alarm() {
        let of_booster =
            ["paper-vars", "random-vars", "former/paper-vars", "former/random-vars", "drift-stream"].map(String::from);
        for name in of_booster.into_iter().chain((0..15).map(|i| format!("concealed/open-{i:02}"))) {
            let (ring, recording) = booster(&name);
            assert_eq!(judge(&ring, &recording), None, "{name}");
        }
        for name in ["ten-cells/plain", "ten-cells/gain", "three-families/campaign", "three-families/gain"] {
            let at = folder().join(name);
            let ring = Ring::read(&at.parent().unwrap().join("ring.json")).unwrap();
            assert_eq!(judge(&ring, &Recording::read(&at, &ring).unwrap()), None, "{name}");
        }
    }

    /// The columns of all rows changed.
    fn changed(recording: &Recording, change: impl Fn(&mut Vec<Option<f64>>, &mut Vec<f64>)) -> Recording {
        let mut changed = recording.clone();
        changed.rows.iter_mut().for_each(|row| change(&mut row.reading, &mut row.corrector_current));
        changed
    }

    fn scale(readings: &mut [Option<f64>], factor: f64) {
        readings.iter_mut().for_each(|reading| *reading = reading.map(|reading| reading * factor));
    }

    #[test]
    #[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
    fn every_wrong_wiring_is_said() {
        use Columns::{Kicks, Readings};
        let (x, y) = (Some(Plane::X), Some(Plane::Y));
        for name in ["former/paper-vars", "concealed/open-05"] {
            let (ring, recording) = booster(name);
            let (split, horizontal) = (ring.horizontal_monitors(), ring.horizontal_correctors());
            let kicks = |change: &dyn Fn(&mut [f64])| changed(&recording, |_, kicks| change(kicks));
            let read = |change: &dyn Fn(&mut [Option<f64>])| changed(&recording, |readings, _| change(readings));
            let cases = [
                (read(&|all| scale(&mut all[..split], -1.0)), Readings(x), Fault::Reversed),
                (read(&|all| scale(&mut all[split..], -1.0)), Readings(y), Fault::Reversed),
                (read(&|all| scale(all, 1e3)), Readings(None), Fault::Scaled(1e3)),
                (read(&|all| scale(all, 1e-3)), Readings(None), Fault::Scaled(1e-3)),
                (read(&|all| all.rotate_right(1)), Readings(None), Fault::Shifted(1)),
                (read(&|all| all[split..].rotate_left(2)), Readings(y), Fault::Shifted(-2)),
                (kicks(&|all| all.iter_mut().for_each(|kick| *kick *= 2.0)), Kicks(None), Fault::Scaled(2.0)),
                (kicks(&|all| all.iter_mut().for_each(|kick| *kick *= 0.5)), Kicks(None), Fault::Scaled(0.5)),
                (kicks(&|all| all.iter_mut().for_each(|kick| *kick *= -1.0)), Kicks(None), Fault::Reversed),
                (kicks(&|all| all.rotate_right(1)), Kicks(None), Fault::Shifted(1)),
                (kicks(&|all| all[..horizontal].rotate_left(1)), Kicks(x), Fault::Shifted(-1)),
            ];
            let moved = |by: isize| {
                let mut moved = recording.clone();
                for (row, from) in moved.rows.iter_mut().zip((0_isize..).map(|i| i - by)) {
                    let own = usize::try_from(from).ok().and_then(|from| recording.rows.get(from));
                    row.reading = own.map_or_else(|| vec![None; ring.read_monitors.len()], |own| own.reading.clone());
                }
                (moved, Readings(None), Fault::Late(by))
            };
            for (recording, columns, fault) in cases.into_iter().chain([moved(1), moved(-1)]) {
                let found = judge(&ring, &recording).unwrap_or_else(|| panic!("{name}: {columns:?} {fault:?} missed"));
                let is_it = |one: &Wiring| one.columns == columns && one.fault == fault;
                assert!(found.0.iter().any(is_it), "{name}: {columns:?} {fault:?}: {found}");
            }
        }
    }

    /// A simulated campaign of a machine, its quadrupoles stronger by a factor by plane.
    fn simulated(factors: [f64; 2], effects: &[Effect], seed: u64) -> Option<(Ring, Recording)> {
        let (ring, template) = booster("former/paper-vars");
        let vars = simulate::vars(&ring, true, seed).unwrap();
        let of = |(m, var): (usize, &f64)| var * factors[usize::from(m >= vars.len() / 2)];
        let vars: Vec<f64> = vars.iter().enumerate().map(of).collect();
        let truth = Truth { vars: &vars, effects, beyond: &[] };
        let made = simulate::campaign(&template, &ring, &truth, &Hardware::shipped(&ring, &template), seed);
        Some((ring, made.ok()?))
    }

    #[test]
    #[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
    fn an_imperfect_machine_or_one_at_other_tunes_raises_no_alarm() {
        let ring = Ring::paper_booster();
        let wave = |i: usize, size: f64| size * f64::sin(2.4 * i as f64 + 0.3);
        let scattered = [
            (EffectKind::BpmGain, 0.06),
            (EffectKind::CorrectorGain, 0.06),
            (EffectKind::BpmRoll, 0.03),
            (EffectKind::CorrectorRoll, 0.03),
            (EffectKind::QuadRoll, 0.004),
        ];
        let of = |(kind, size): (EffectKind, f64)| {
            let sites = kind.sites(&ring).into_iter().enumerate();
            sites.map(move |(i, site)| Effect { kind, site, amplitude: wave(i, size) }).collect::<Vec<_>>()
        };
        let imperfect: Vec<Effect> = scattered.into_iter().flat_map(of).collect();
        let parse = |text: &str| Effect::parse(text, &ring).unwrap();
        let one = |text: &str| vec![parse(text)];
        let cases = [
            imperfect,
            one("radial_loop@x_D8,x_E6"),
            one("fixed_rf_frequency"),
            one("bpm_polarity@x_E4"),
            one("corrector_polarity@V_D3"),
            one("bpm_swap@x_E4,x_E6"),
        ];
        for (seed, effects) in cases.iter().enumerate() {
            let (ring, recording) = simulated([1.0; 2], effects, seed as u64).unwrap();
            assert_eq!(judge(&ring, &recording), None, "{:?}", effects[0]);
        }
        let mut far = 0;
        for x in [-0.03, -0.015, 0.0, 0.03] {
            for y in [-0.03, -0.015, 0.0, 0.02, 0.03] {
                let Some((ring, recording)) = simulated([1.0 + x, 1.0 + y], &[], 3) else { continue };
                assert_eq!(judge(&ring, &recording), None, "{x} {y}: tunes {:?}", recording.rows[0].tune);
                far += 1;
            }
        }
        assert!(far > 12, "{far}");
    }
}
