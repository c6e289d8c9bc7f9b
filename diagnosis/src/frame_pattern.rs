//! What moves all monitors together from frame to frame, in a pattern that nothing is known of beforehand.
//!
//! It is learnt from differences of frames within a run of one setting (`factors.rs`), beside the momentum's jitter and the crates or in their
//! place, whichever is more likely. Patterns of which only the size is unknown compete with free ones: betatron motion of random phase in either
//! plane, and a kick at one place, as the fitted optics have them. Free ones have half of the prior. They are said to resemble what describes nine
//! tenths of their variance.
//!
//! Ordinary are that of the momentum, and orbits that misaligned quadrupoles make of the ripple of their supplies which the read-backs do not show,
//! taken for as large as the ripple that they do, up to a size. Two supplies move the orbit in two phases, which next to an integer tune are those of betatron motion. With the ordinary size t a half-normal prior has its width at, and with a
//! prior of unordinary sizes s that is flat in `ln s` over seven octaves from t on, as many as an unmodelled discrepancy has,
//!
//! `ln Bayes factor = (s/t)^2/2 - ln(s/t) - ln(7 ln 2) + ln(pi/2)/2`,
//!
//! which with the prior of an unmodelled cause gives even odds at 3.8 t. A periodic momentum is no jitter either: of the probability p that chance would
//! give such a period, `-ln(-e p ln p)` is taken.
//!
//! Source: T. Sellke, M. J. Bayarri and J. O. Berger, Am. Stat. 55 (2001) 62, what a p-value says of a hypothesis at most.

use core::f64::consts::{E, FRAC_PI_2, LN_2};

use nalgebra::{DMatrix, DVector};
use twin::{Measured, Optics, OrbitError, Plane, Ring};

use super::columns::beside;
use super::factors::{Factors, Seen};
use super::jitter::Differences;
use super::laplace::Peak;
use super::period::Period;
use super::transients::run_means;

/// What a pattern is like.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Like {
    /// Betatron motion in a plane.
    Betatron(Plane),
    /// A change of the momentum.
    Momentum,
    /// A kick in a plane at the entrance of a quadrupole.
    Kick(usize, Plane),
    /// None of these.
    Nothing,
}

/// A pattern of one size: one column or more, of random amplitudes [monitors][columns].
#[derive(Debug, Clone)]
pub struct Shape {
    /// What it is of.
    pub like: Like,
    /// As the optics have it, in any unit that is the same for all monitors.
    pub columns: DMatrix<f64>,
}

/// What varies from frame to frame.
#[derive(Debug, Clone, PartialEq)]
pub struct FrameToFrame {
    /// Patterns of random amplitudes of variance 1, beside the momentum's [monitors][patterns] [m].
    pub patterns: DMatrix<f64>,
    /// What they are like.
    pub like: Like,
    /// Rms over the frames and the monitors [m].
    pub rms: Measured,
    /// `ln` Bayes factor over ordinary noise.
    pub log_bayes: f64,
    /// Their period, if they have one.
    pub period: Option<Period>,
}

/// Patterns that are known, with what learning them has cost of `ln` evidence.
pub struct Known {
    /// In units of the differences.
    pub modes: DMatrix<f64>,
    /// [nat]
    pub cost: f64,
}

/// A pattern that was found.
pub struct Found {
    /// In units of the differences [monitors][patterns].
    pub patterns: DMatrix<f64>,
    /// What it is like.
    pub like: Like,
    /// `ln` Bayes factor over the known patterns alone.
    pub log_bayes: f64,
}

/// Unknown patterns at most: betatron motion has two in each plane.
const MOST: usize = 4;
/// Sizes of a known shape over the whole noise, at its largest: from there to 1 its logarithm is equally likely.
const SMALLEST: f64 = 0.05;
const SIZES: usize = 12;
/// Share of a pattern's variance that a shape has to describe.
const RESEMBLES: f64 = 0.9;
/// Prior probability of a free pattern, the known shapes having the rest.
const FREE: f64 = 0.5;
/// Octaves of unordinary sizes.
const OCTAVES: f64 = 7.0;

impl Shape {
    /// All of some optics, at the read monitors.
    pub fn all(optics: &Optics, ring: &Ring) -> Result<Vec<Self>, OrbitError> {
        let twiss = optics.twiss()?;
        let observers = optics.read_monitors();
        let planes = [Plane::X, Plane::Y];
        let betatron = |plane: Plane| {
            let i = usize::from(plane == Plane::Y);
            let rows: Vec<[f64; 2]> = (ring.monitors_read())
                .map(|monitor| {
                    let optics_there = &twiss[monitor.element];
                    let (sin, cos) = optics_there.phase_advance[i].sin_cos();
                    if monitor.plane == plane {
                        [cos, sin].map(|of| optics_there.beta[i].sqrt() * of)
                    } else {
                        [0.0; 2]
                    }
                })
                .collect();
            Self { like: Like::Betatron(plane), columns: DMatrix::from_fn(rows.len(), 2, |b, k| rows[b][k]) }
        };
        let kicks = |plane: Plane| {
            let direction = if plane == Plane::X { [1.0, 0.0] } else { [0.0, 1.0] };
            let sources: Vec<_> = ring.quadrupoles.iter().map(|q| optics.kick(q.element, direction)).collect();
            let response = optics.response(&observers, &sources);
            let shape =
                move |q: usize| Self { like: Like::Kick(q, plane), columns: response.columns(q, 1).into_owned() };
            (0..sources.len()).map(shape)
        };
        let dispersion = optics.dispersion_of(&observers);
        let momentum = Self { like: Like::Momentum, columns: DMatrix::from_columns(&[dispersion]) };
        let all = planes.into_iter().map(betatron).chain(planes.into_iter().flat_map(kicks)).chain([momentum]);
        Ok(all.collect())
    }

    /// Over the noise of each monitor, 0 for one of which it is not known; the largest is 1. None where no monitor sees it.
    fn over(&self, noise: &[Option<f64>]) -> Option<Self> {
        let mut columns = self.columns.clone();
        columns.row_iter_mut().zip(noise).for_each(|(mut row, noise)| row *= noise.map_or(0.0, |noise| 1.0 / noise));
        let largest = columns.row_iter().map(|row| row.norm()).fold(0.0, f64::max);
        (largest > 0.0).then(|| Self { columns: columns / largest, ..*self })
    }

    /// Share of the variance of some patterns that it describes.
    fn share(&self, patterns: &DMatrix<f64>) -> f64 {
        let q = self.columns.clone().qr().q();
        q.tr_mul(patterns).norm_squared() / patterns.norm_squared().max(f64::MIN_POSITIVE)
    }
}

impl Found {
    /// The most likely pattern, beside or in the place of known ones, of which each has those before it; `noise`: of each monitor whose differences
    /// there are [m]. A pattern has to be needed beside all that are known too: it might only be the cheaper description of a crate.
    pub fn strongest(near: &Differences, known: &[Known], shapes: &[Shape], noise: &[Option<f64>]) -> Option<Self> {
        let seen = Seen::from_differences(&near.all);
        let shapes: Vec<Shape> = shapes.iter().filter_map(|shape| shape.over(noise)).collect();
        let (mut nothing, mut beside_all) = (f64::NEG_INFINITY, f64::NEG_INFINITY);
        let mut best: Option<Self> = None;
        for one in known {
            let none = DMatrix::zeros(one.modes.nrows(), 0);
            let without = Factors::learn(&seen, &one.modes, &none).log_evidence - one.cost;
            nothing = nothing.max(without);
            let free = free(near, &seen, one).map(|(patterns, log)| {
                let like = like(&patterns, &shapes);
                Self { patterns, like, log_bayes: log + FREE.ln() }
            });
            let of_shape = known_shape(near, &one.modes, &shapes).map(|(shape, size, gain)| Self {
                patterns: &shape.columns * size,
                like: shape.like,
                log_bayes: without + gain + ((1.0 - FREE) / shapes.len() as f64).ln(),
            });
            let logs = free.iter().chain(&of_shape).map(|found| found.log_bayes);
            beside_all = logs.fold(f64::NEG_INFINITY, f64::max) - without;
            let all = best.into_iter().chain(free).chain(of_shape);
            best = all.max_by(|a, b| a.log_bayes.total_cmp(&b.log_bayes));
        }
        best.map(|best| Self { log_bayes: beside_all.min(best.log_bayes - nothing), ..best })
    }
}

impl FrameToFrame {
    /// In the table.
    pub fn name(&self) -> &'static str {
        match self.like {
            Like::Betatron(Plane::X) => "betatron motion in x from frame to frame",
            Like::Betatron(Plane::Y) => "betatron motion in y from frame to frame",
            Like::Momentum => "orbit like the dispersion from frame to frame",
            Like::Kick(_, Plane::X) => "orbit of a horizontal kick from frame to frame",
            Like::Kick(_, Plane::Y) => "orbit of a vertical kick from frame to frame",
            Like::Nothing => "common pattern from frame to frame",
        }
    }

    /// As a clause of the sentence.
    pub fn phrase(&self, ring: &Ring) -> String {
        let size = format!("{:.3} mm rms", self.rms.value * 1e3);
        let of_plane = |plane: &Plane| if *plane == Plane::X { "horizontal" } else { "vertical" };
        let what = match &self.like {
            Like::Betatron(plane) => format!("as {} betatron motion does", of_plane(plane)),
            Like::Momentum => "as a change of the momentum does".into(),
            Like::Kick(q, plane) => {
                format!("as a {} kick near {} does", of_plane(plane), ring.label(ring.quadrupoles[*q].element))
            }
            Like::Nothing => "in a pattern that monitors share".into(),
        };
        let period = self.period.map_or(String::new(), |period| format!(", {}", period.phrase()));
        format!("the orbit changes from frame to frame by {size}, {what}{period}")
    }

    /// The element nearest to what moves the orbit, where it is known.
    pub fn element(&self, ring: &Ring) -> Option<usize> {
        match self.like {
            Like::Kick(q, _) => Some(ring.quadrupoles[q].element),
            _ => None,
        }
    }
}

/// The most likely number of free patterns beside known ones, with `ln` evidence less their cost.
fn free(near: &Differences, seen: &Seen, known: &Known) -> Option<(DMatrix<f64>, f64)> {
    let correlation = near.correlation(&known.modes).symmetric_eigen();
    let mut order: Vec<usize> = (0..correlation.eigenvalues.len()).collect();
    order.sort_by(|&a, &b| correlation.eigenvalues[b].total_cmp(&correlation.eigenvalues[a]));
    // products are in units of the error of their mean
    let scale = (seen.frames().max(1) as f64).sqrt();
    let start = |k: usize| {
        let column =
            |&i: &usize| correlation.eigenvectors.column(i) * (correlation.eigenvalues[i] / scale).max(0.01).sqrt();
        DMatrix::from_columns(&order.iter().take(k).map(column).collect::<Vec<_>>())
    };
    let mut best: Option<(DMatrix<f64>, f64)> = None;
    for k in 1..=MOST.min(order.len()) {
        let Factors { patterns, log_evidence } = Factors::learn(seen, &known.modes, &start(k));
        let log = log_evidence - known.cost;
        if best.as_ref().is_some_and(|(_, before)| log < *before) {
            break;
        }
        best = Some((patterns, log));
    }
    best
}

/// The most likely of the known shapes that are not the momentum's, its size, and its gain of `ln` evidence.
fn known_shape<'s>(near: &Differences, known: &DMatrix<f64>, shapes: &'s [Shape]) -> Option<(&'s Shape, f64, f64)> {
    let without = near.log_likelihood(known);
    let with = |shape: &Shape, size: f64| {
        let columns = shape.columns.column_iter().map(|column| column * size);
        near.log_likelihood(&columns.fold(known.clone(), |modes, column| beside(modes, &column))) - without
    };
    let range = -SMALLEST.ln();
    let sizes = (0..SIZES).map(|i| -range * (i as f64 + 0.5) / SIZES as f64);
    let tried = (shapes.iter().filter(|shape| shape.like != Like::Momentum))
        .flat_map(|shape| sizes.clone().map(move |size| (shape, size)));
    let (shape, start, _) =
        tried.map(|(shape, size)| (shape, size, with(shape, size.exp()))).max_by(|a, b| a.2.total_cmp(&b.2))?;
    let peak = Peak::find(|x| with(shape, x[0].exp()), &DVector::from_element(1, start), &[[-range, 0.0]])?;
    Some((shape, peak.at[0].exp(), peak.log_integral - range.ln()))
}

/// What free patterns resemble. One pattern has one phase, which betatron motion has not.
fn like(patterns: &DMatrix<f64>, shapes: &[Shape]) -> Like {
    let may_be = |shape: &&Shape| patterns.ncols() > 1 || shape.columns.ncols() == 1;
    let shares = shapes.iter().filter(may_be).map(|shape| (shape.like, shape.share(patterns)));
    let best = shares.max_by(|a, b| a.1.total_cmp(&b.1)).filter(|(_, share)| *share > RESEMBLES);
    best.map_or(Like::Nothing, |(like, _)| like)
}

/// `ln` Bayes factor of an unordinary size, given in widths of the ordinary one's half-normal prior; within the first of these none is unordinary.
pub fn beyond_ordinary(size: f64) -> f64 {
    if size < 1.0 {
        return f64::NEG_INFINITY;
    }
    0.5 * size * size - size.ln() - (OCTAVES * LN_2).ln() + 0.5 * FRAC_PI_2.ln()
}

/// At most this `ln` Bayes factor has what chance would give with some probability, its logarithm given.
pub fn beyond_chance(log_chance: f64) -> f64 {
    -(log_chance + E.ln() + (-log_chance).ln())
}

/// Amplitudes of the largest of some patterns [m] in each frame, from readings less their prediction about the mean of their run, not a
/// number where there is none; `noise` of each monitor [m], none for one that does not count. `settings`: that of each frame.
pub fn amplitudes(
    patterns: &DMatrix<f64>,
    residual: &DMatrix<f64>,
    noise: &[Option<f64>],
    settings: &[Option<usize>],
) -> Vec<f64> {
    let monitors: Vec<usize> = (0..noise.len()).filter(|&b| noise[b].is_some()).collect();
    let weight = |b: usize| noise[b].map_or(0.0, |noise| noise.powi(-2));
    let largest = patterns.clone().svd(false, true).v_t.map(|v| patterns * v.row(0).transpose());
    let Some(pattern) = largest else { return vec![f64::NAN; residual.nrows()] };
    let about = residual - run_means(residual, settings);
    let amplitude = |row: usize| {
        let seen = monitors.iter().filter(|&&b| !about[(row, b)].is_nan());
        let sum = |(pull, information): (f64, f64), &b: &usize| {
            let share = weight(b) * pattern[b];
            (pull + share * about[(row, b)], information + share * pattern[b])
        };
        let (pull, information) = seen.fold((0.0, 0.0), sum);
        pull / information
    };
    (0..residual.nrows()).map(amplitude).collect()
}

#[cfg(test)]
mod tests {
    use core::f64::consts::TAU;

    use estimator::MonitorState;
    use inference::recording::Recording;
    use rand::rngs::StdRng;
    use rand::{RngExt, SeedableRng};
    use twin::Hold;

    use super::*;
    use crate::Diagnosis;
    use crate::data::Data;
    use crate::location::Location;
    use crate::noise::Noise;
    use crate::odds::correction_of_sort;
    use crate::period::Recurs;
    use crate::testing::{Coloured, normal, template, whitened};
    use crate::verdict::Verdict;

    /// The shapes of the machine of some vars, and a campaign of it with one of them [m] of some amplitudes in each frame.
    struct Case {
        ring: Ring,
        recording: Recording,
        noise: Coloured,
        shapes: Vec<Shape>,
    }

    impl Case {
        fn new(seed: u64) -> Self {
            let (ring, recording) = template();
            let noise = Coloured::white(&ring, &recording, seed);
            let made = recording.powered(&ring).with_vars(&noise.vars);
            let shapes = Shape::all(&Optics::of(&made, Hold::Momentum { delta: 0.0 }).unwrap(), &made).unwrap();
            Self { ring, recording, noise, shapes }
        }

        /// Columns of a shape, their largest row of length 1.
        fn shape(&self, like: Like) -> DMatrix<f64> {
            let columns = &self.shapes.iter().find(|shape| shape.like == like).unwrap().columns;
            columns / columns.row_iter().map(|row| row.norm()).fold(0.0, f64::max)
        }

        /// Rms over the monitors whose noise is learnt, the faulty ones left out.
        fn rms(&self, made: &DMatrix<f64>, data: &Data) -> f64 {
            let sound = |b: &usize| data.health()[*b].state == MonitorState::Ok;
            let sound: Vec<usize> = (0..made.ncols()).filter(sound).collect();
            let square = |b: &usize| made.column(*b).norm_squared() / made.nrows() as f64;
            (sound.iter().map(square).sum::<f64>() / sound.len() as f64).sqrt()
        }

        fn with(&mut self, common: &DMatrix<f64>) -> Recording {
            self.noise.common = common.clone();
            self.noise.campaign(&self.ring, &self.recording, &[])
        }

        fn frames(&self) -> usize {
            self.recording.rows.len()
        }

        fn learnt(&self, recording: &Recording) -> Noise {
            whitened(&self.ring, recording).noise
        }
    }

    #[test]
    #[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
    fn betatron_motion_of_random_phase_is_no_noise() {
        let mut case = Case::new(3);
        let mut random = StdRng::seed_from_u64(3);
        for plane in [Plane::X, Plane::Y] {
            let columns = case.shape(Like::Betatron(plane)) * 4e-4;
            let mut common = DMatrix::zeros(case.frames(), columns.nrows());
            for mut frame in common.row_iter_mut() {
                let (sin, cos) = random.random_range(0.0..TAU).sin_cos();
                frame.copy_from(&(&columns * DVector::from_vec(vec![cos, sin])).transpose());
            }
            let made = case.with(&common);
            let diagnosis = Diagnosis::from_recording(&case.ring, &made, |_| ()).unwrap();
            let noise = &diagnosis.found.data.noise;
            let found = noise.frame_to_frame.as_ref().unwrap();
            println!("{} {:.1}", diagnosis.sentence, found.log_bayes);
            assert_eq!((diagnosis.verdict, found.like), (Verdict::Unexplained, Like::Betatron(plane)));
            let last = diagnosis.findings.last().unwrap();
            assert_eq!(last.at, Location::FrameToFrame.label(&diagnosis.found.data));
            // a sine of fixed amplitude scatters less than a normal one, and the screening drops its largest readings: 10 %
            assert!((found.rms.value / case.rms(&common, &diagnosis.found.data) - 1.0).abs() < 0.1, "{:?}", found.rms);
            // the monitors get their own noise back
            let header = case.recording.header.noise[0];
            assert!(
                (case.noise.noise / header / noise.common_scale.value - 1.0).abs() < 0.05,
                "{:?}",
                noise.common_scale
            );
        }
    }

    #[test]
    #[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
    fn a_momentum_of_every_seventh_frame_is_no_jitter() {
        let mut case = Case::new(4);
        // 5e-5 of some 1.5 m to 3 m
        let pattern = case.noise.dispersion.transpose() * 5e-5;
        let common = DMatrix::from_fn(case.frames(), pattern.len(), |i, b| if i % 7 == 3 { pattern[b] } else { 0.0 });
        let made = case.with(&common);
        let diagnosis = Diagnosis::from_recording(&case.ring, &made, |_| ()).unwrap();
        let found = diagnosis.found.data.noise.frame_to_frame.clone().unwrap();
        println!("{} {:.1}", diagnosis.sentence, found.log_bayes);
        assert_eq!((diagnosis.verdict, found.like), (Verdict::Unexplained, Like::Momentum));
        assert_eq!(found.period.unwrap().recurs, Recurs::Every(7));
    }

    #[test]
    #[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
    fn a_kick_that_flips_is_found_near_its_place() {
        let mut case = Case::new(5);
        let mut random = StdRng::seed_from_u64(5);
        for (q, plane) in [(7, Plane::X), (30, Plane::Y)] {
            let pattern = case.shape(Like::Kick(q, plane)) * 5e-4;
            let state: Vec<f64> = (0..case.frames()).map(|_| f64::from(random.random_range(0..2))).collect();
            let common = DMatrix::from_fn(case.frames(), pattern.nrows(), |i, b| state[i] * pattern[b]);
            let made = case.with(&common);
            let noise = case.learnt(&made);
            let (found, _) = noise.unordinary().unwrap();
            println!("{} {:.1}", found.phrase(&case.ring), found.log_bayes);
            let Like::Kick(at, in_plane) = found.like else { panic!("{:?}", found.like) };
            let quadrupoles = case.ring.quadrupoles.len();
            let apart = at.abs_diff(q).min(quadrupoles - at.abs_diff(q));
            // 31 monitors are one and a half quadrupoles apart, those of one plane three
            assert!(in_plane == plane && apart <= 2, "{at} {in_plane:?}");
        }
    }

    #[test]
    #[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
    fn ordinary_noise_has_no_pattern() {
        let case = Case::new(6);
        for seed in 0..4 {
            let white = || Coloured::white(&case.ring, &case.recording, 200 + seed);
            for truth in [
                Coloured { momentum: 4e-5, ..white() },
                Coloured { crate_share: 0.25, slow: (0.2, 5.0), ..white() },
                Coloured { momentum: 4e-5, crate_share: 0.25, walk: 6e-6, ..white() },
            ] {
                let noise = case.learnt(&truth.campaign(&case.ring, &case.recording, &[]));
                assert!(noise.unordinary().is_none(), "{seed} {:?}", noise.frame_to_frame);
                assert!(noise.remarks().is_empty(), "{:?}", noise.common_scale);
            }
        }
    }

    #[test]
    #[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
    fn noise_far_from_the_header_is_said() {
        let case = Case::new(8);
        let white = || Coloured::white(&case.ring, &case.recording, 8);
        let louder = Coloured { noise: 3.0 * case.noise.noise, ..white() };
        let noise = case.learnt(&louder.campaign(&case.ring, &case.recording, &[]));
        assert!(noise.unordinary().is_none() && !noise.remarks().is_empty(), "{:?}", noise.common_scale);
        // the orbit moves by six times the noise where the dispersion is largest
        let momentum = 6.0 * case.noise.noise / case.noise.dispersion.amax();
        let jitter = Coloured { momentum, ..white() };
        let noise = case.learnt(&jitter.campaign(&case.ring, &case.recording, &[]));
        assert_eq!(noise.unordinary().unwrap().0.like, Like::Momentum);
    }

    /// Differences of empty campaigns, with jitter and a crate: the evidence of the best pattern stays below even odds by more than three of
    /// its standard deviations, which is less than one false alarm in a hundred for any distribution with one peak (Vysochanskij and Petunin,
    /// 1980: 4/81 on both sides), and in 740 for a normal one.
    #[test]
    #[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
    fn empty_campaigns_give_no_alarm() {
        const CAMPAIGNS: usize = 40;
        let case = Case::new(7);
        let monitors = case.noise.dispersion.len();
        let per_momentum = &case.noise.dispersion / case.noise.dispersion.amax();
        let mut random = StdRng::seed_from_u64(7);
        let none = DMatrix::zeros(monitors, 0);
        let mut logs = Vec::new();
        for campaign in 0..CAMPAIGNS {
            let jitter = &per_momentum * (0.5 * (campaign % 2) as f64);
            let mut all = DMatrix::zeros(240, monitors);
            for mut frame in all.row_iter_mut() {
                let common = normal(&mut random);
                for (z, g) in frame.iter_mut().zip(jitter.iter()) {
                    *z = (1.0 - g * g).sqrt() * normal(&mut random) + g * common;
                }
            }
            all.iter_mut().skip(campaign).step_by(57).for_each(|z| *z = f64::NAN);
            let cost = 0.5 * 240_f64.ln();
            let known =
                [Known { modes: none.clone(), cost: 0.0 }, Known { modes: beside(none.clone(), &jitter), cost }];
            let noise = vec![Some(case.noise.noise); monitors];
            logs.push(
                Found::strongest(&Differences::from_frames(all), &known, &case.shapes, &noise)
                    .map_or(f64::NEG_INFINITY, |one| one.log_bayes),
            );
        }
        let mean = logs.iter().sum::<f64>() / CAMPAIGNS as f64;
        let sigma = (logs.iter().map(|log| (log - mean).powi(2)).sum::<f64>() / CAMPAIGNS as f64).sqrt();
        let largest = logs.iter().copied().fold(f64::NEG_INFINITY, f64::max);
        println!("{mean:.2} ± {sigma:.2}, largest {largest:.2}, even odds at {:.2}", correction_of_sort());
        assert!(mean + 3.0 * sigma < correction_of_sort());
    }

    #[test]
    fn unordinary_sizes_begin_at_nearly_four_widths() {
        assert!(beyond_ordinary(3.9) < correction_of_sort() && beyond_ordinary(4.0) > correction_of_sort());
        // a period that chance gives once in a hundred recordings is no evidence, of one in a million it is
        assert!(
            beyond_chance(0.01_f64.ln()) < correction_of_sort() && beyond_chance(1e-6_f64.ln()) > correction_of_sort()
        );
    }
}
