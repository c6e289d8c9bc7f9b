//! A model that is believed, and what a measurement says against it.
//!
//! A model is the values of an earlier fit. What it does not state is as designed: a factor or a gain of 1, no coupling, no skew gradient. A
//! value that is taken out of it is found again by a measurement that needs it, with everything else adapting.

use glob::Pattern;
use nalgebra::{DMatrix, DVector};

use crate::data::Data;
use crate::departure::{Departures, Expected};
use crate::error::MeasuredError;
use crate::fit::{Fit, Settings};
use crate::folder::Folder;
use crate::model::Model;
use crate::unknowns::{Kind, Unknown, name};
use crate::wiring::{Wiring, straightened_by};

/// One value of a model.
#[derive(Debug, Clone, PartialEq)]
pub struct Value {
    /// What it is, as [`Kind::word`].
    pub kind: String,
    /// Where.
    pub at: String,
    /// The value.
    pub value: f64,
    /// Its standard deviation, 0 where it is exact.
    pub sigma: f64,
}

/// A model that is believed.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Believed {
    /// Its values.
    pub values: Vec<Value>,
    /// Cables that are wrong in it: kind and place as [`Wiring::named`].
    pub cables: Vec<[String; 2]>,
}

/// What a measurement says against one value of a model.
#[derive(Debug, Clone, PartialEq)]
pub struct Departure {
    /// What it is.
    pub kind: Kind,
    /// Where.
    pub at: String,
    /// Of a strength or a gain relative; of what is read or kicked in the other plane per gain, of a skew gradient [1/m] the departure itself.
    pub amplitude: f64,
    /// Its standard deviation.
    pub sigma: f64,
    /// `ln` Bayes factor against none [nat].
    pub log_evidence_gain: f64,
}

/// What a measurement says against a model.
#[derive(Debug, Clone, PartialEq)]
pub struct Against {
    /// Cables that the model has right and the measurement has not.
    pub wiring: Vec<Wiring>,
    /// Values, the clearest first.
    pub departures: Vec<Departure>,
}

impl Believed {
    /// The values of a fit, and the cables that were put right before it.
    pub fn of(folder: &Folder, cables: &[Wiring], fitted: &Fit) -> Self {
        let value = |(index, unknown): (usize, &Unknown)| {
            let at = name(folder, &fitted.groups, unknown.kind);
            Value { kind: unknown.kind.word().into(), at, value: fitted.values[index], sigma: fitted.sigma(index) }
        };
        let named = |one: &Wiring| {
            let (kind, at) = one.named(folder);
            [kind.to_owned(), at]
        };
        Self {
            values: fitted.unknowns.iter().enumerate().map(value).collect(),
            cables: cables.iter().map(named).collect(),
        }
    }

    /// Take out what a pattern names: a place (`x_BPM.3`, `SD*`), or a kind and a place (`skew_gradient *`). How many values that were.
    ///
    /// # Errors
    /// [`MeasuredError::Convention`]: no pattern, or one that names nothing of the model.
    pub fn take_out(&mut self, named: &str) -> Result<usize, MeasuredError> {
        let (kind, place) = named.split_once(' ').unwrap_or(("*", named));
        let pattern = |text: &str| {
            Pattern::new(text).map_err(|error| MeasuredError::Convention(format!("{named}: not a pattern: {error}")))
        };
        let (kind, place) = (pattern(kind)?, pattern(place)?);
        let is_it = |of: &str, at: &str| kind.matches(of) && place.matches(at);
        let before = self.values.len() + self.cables.len();
        self.values.retain(|one| !is_it(&one.kind, &one.at));
        self.cables.retain(|[of, at]| !is_it(of, at));
        match before - self.values.len() - self.cables.len() {
            0 => Err(MeasuredError::Convention(format!("{named}: the model has no such value, of {before}"))),
            some => Ok(some),
        }
    }

    /// Its values of the unknowns of a fit and their standard deviations, as designed and 0 where it has none.
    ///
    /// # Errors
    /// [`MeasuredError::Unlike`]: it has a value that the fit has not.
    fn values(&self, folder: &Folder, fitted: &Fit) -> Result<[DVector<f64>; 2], MeasuredError> {
        let mut values = DVector::from_iterator(fitted.unknowns.len(), fitted.unknowns.iter().map(|one| one.mean));
        let mut sigma = DVector::zeros(fitted.unknowns.len());
        for one in &self.values {
            let is_it = |kind: Kind| {
                kind.word() == one.kind
                    && match kind {
                        // each magnet of a group has its factor
                        Kind::Strength(group) => {
                            fitted.groups[0][group].iter().any(|&row| folder.element(row) == one.at)
                        }
                        _ => name(folder, &fitted.groups, kind) == one.at,
                    }
            };
            match fitted.unknowns.iter().position(|unknown| is_it(unknown.kind)) {
                Some(at) => (values[at], sigma[at]) = (one.value, one.sigma),
                // what is dead by now tells nothing
                None if is_instrument(folder, &one.at) => {}
                None => {
                    let what = format!("the model has {} at {}, {} has none", one.kind, one.at, folder.name);
                    return Err(MeasuredError::Unlike(what));
                }
            }
        }
        Ok([values, sigma])
    }
}

/// Covariance of the values of a model that a measurement like this one gave, from their standard deviations: with `C` and `P` the covariance
/// and the prior's precision of this fit and `S` the ratios of the standard deviations, `S (C - C P C) S`. What the prior holds differs between
/// no two measurements, so that it counts as exact. What the model does not state is as designed beside what it states: of a scale that gains
/// and kicks have in common it has the same error, by the mean of `S`.
fn covariance(fitted: &Fit, sigma: &DVector<f64>) -> DMatrix<f64> {
    let whole = &fitted.uncertainty.independent;
    let held = DVector::from_iterator(sigma.len(), fitted.unknowns.iter().map(|one| one.width.powi(-2)));
    let by_data = whole - whole * DMatrix::from_diagonal(&held) * whole;
    let ratio = sigma.map_with_location(|i, _, sigma| sigma / whole[(i, i)].sqrt());
    let stated = ratio.iter().filter(|ratio| **ratio > 0.0);
    let mean = stated.clone().sum::<f64>() / stated.count().max(1) as f64;
    let ratio = DMatrix::from_diagonal(&ratio.map(|ratio| if ratio > 0.0 { ratio } else { mean }));
    &ratio * by_data * &ratio
}

fn is_instrument(folder: &Folder, name: &str) -> bool {
    (0..folder.monitors.len()).any(|row| folder.monitor(row) == name)
        || (0..folder.correctors.len()).any(|column| folder.corrector(column) == name)
}

/// Instruments in use that a fit has left out.
fn dead(folder: &Folder, fitted: &Fit) -> Vec<Wiring> {
    let is_left_out = |kind: Kind| !fitted.unknowns.iter().any(|one| one.kind == kind);
    let rows = (0..folder.monitors.len()).filter(|&row| folder.monitors[row].is_used);
    let rows: Vec<usize> = rows.filter(|&row| is_left_out(Kind::MonitorGain(row))).collect();
    let columns = (0..folder.correctors.len()).filter(|&column| folder.correctors[column].is_used);
    let columns: Vec<usize> = columns.filter(|&column| is_left_out(Kind::CorrectorGain(column))).collect();
    let monitors = (!rows.is_empty()).then_some(Wiring::MonitorsDead(rows));
    monitors.into_iter().chain((!columns.is_empty()).then_some(Wiring::CorrectorsDead(columns))).collect()
}

/// What a measurement, as it was measured and as it was fitted by itself, says against a model.
///
/// # Errors
/// [`MeasuredError`]; [`MeasuredError::Unlike`] where the model is not one of this ring.
pub fn against(
    folder: &Folder,
    fitted: &Fit,
    believed: &Believed,
    settings: &Settings,
    progress: &mut dyn FnMut(&str),
) -> Result<Against, MeasuredError> {
    let [values, sigma] = believed.values(folder, fitted)?;
    let expected = Expected { covariance: Some(covariance(fitted, &sigma)), values };
    let mut folder = folder.clone();
    for [kind, at] in &believed.cables {
        Wiring::of_name(&folder, kind, at)?.put_right(&mut folder);
    }
    let dead = dead(&folder, fitted);
    dead.iter().for_each(|one| one.put_right(&mut folder));
    let model = Model::of(&folder, &fitted.groups, settings.rf)?;
    let predicted = model.predict(&fitted.unknowns, &expected.values)?.matrix;
    let (folder, mut wiring) = straightened_by(&folder, &predicted.columns(0, folder.correctors.len()).into_owned());
    wiring.extend(dead);
    let mut data = Data::of(&folder);
    fitted.outliers.iter().for_each(|&[row, column]| data.sigma[(row, column)] = f64::INFINITY);
    let found = Departures::of(&model, &fitted.unknowns, &expected, &data, progress)?;
    let departure = |at: usize| {
        let (amplitude, sigma) = found.change(at);
        let kind = found.unknowns[at].kind;
        let log_evidence_gain = found.log_evidence_gain(at);
        Departure { kind, at: name(&folder, &fitted.groups, kind), amplitude, sigma, log_evidence_gain }
    };
    let clear = (0..found.unknowns.len()).filter(|&at| found.is_clear(found.change(at)));
    let mut departures: Vec<Departure> = clear.map(departure).collect();
    departures.sort_by(|a, b| (b.amplitude / b.sigma).abs().total_cmp(&(a.amplitude / a.sigma).abs()));
    Ok(Against { wiring, departures })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fit::fit;
    use crate::straight::Straightened;
    use crate::testing::{NOISE, machine, measured, ring};

    #[test]
    fn what_is_taken_out_is_found_again() {
        let ring = ring();
        let (model, unknowns, mut values) = machine(&ring, 21);
        // at the edge of the fit's prior, well beyond that of a departure
        for (unknown, value) in unknowns.iter().zip(values.iter_mut()) {
            if let Kind::Skew(group) = unknown.kind {
                *value = if group % 2 == 0 { 0.01 } else { -0.01 };
            }
        }
        let plain = measured(&ring, &(model, unknowns, values), NOISE, 3);
        let cable = Wiring::MonitorsExchanged(vec![2, 9]);
        let mut folder = plain.clone();
        cable.put_right(&mut folder);
        let settings = Settings::default();
        let fitted = fit(&plain, &settings, &mut |_| ()).unwrap();
        let mut model = Believed::of(&plain, &[], &fitted);
        let nothing = against(&plain, &fitted, &model, &settings, &mut |_| ()).unwrap();
        assert_eq!((nothing.wiring.len(), nothing.departures.len()), (0, 0), "{nothing:?}");
        // the monitor that is farthest off, and all skew gradients
        let rows = (0..24).map(Kind::MonitorGain);
        let value = |kind: Kind| fitted.values[fitted.unknowns.iter().position(|one| one.kind == kind).unwrap()];
        let row = rows.max_by(|&a, &b| (value(a) - 1.0).abs().total_cmp(&(value(b) - 1.0).abs())).unwrap();
        let at = name(&plain, &fitted.groups, row);
        assert_eq!(model.take_out(&format!("bpm_gain {at}")).unwrap(), 1);
        assert_eq!(model.take_out("skew_gradient SD*").unwrap(), 4);
        let found = against(&folder, &fitted, &model, &settings, &mut |_| ()).unwrap();
        assert_eq!(found.wiring, [cable]);
        for one in &found.departures {
            let is_skew = matches!(one.kind, Kind::Skew(_));
            assert!(is_skew || one.kind == row, "{one:?}");
            let hidden = if is_skew { value(one.kind) } else { value(one.kind) - 1.0 };
            assert!((one.amplitude - hidden).abs() < 4.0 * one.sigma && one.log_evidence_gain > 3.0, "{one:?}");
        }
        assert!(found.departures.iter().any(|one| one.kind == row), "{found:?}");
        assert!(found.departures.iter().filter(|one| matches!(one.kind, Kind::Skew(_))).count() > 1, "{found:?}");
    }

    /// Two measurements of one machine with noise of their own, five times as large: how many of some pairs have departures from the model fitted to
    /// the first.
    fn false_alarms(pairs: u64, is_exact: bool) -> usize {
        let (ring, settings) = (ring(), Settings::default());
        let has_some = |seed: &u64| {
            let truth = machine(&ring, *seed);
            let [before, now] = [1000, 2000].map(|of| measured(&ring, &truth, 5.0 * NOISE, of + seed));
            let fits = [&before, &now].map(|folder| fit(folder, &settings, &mut |_| ()).unwrap());
            let mut model = Believed::of(&before, &[], &fits[0]);
            if is_exact {
                model.values.iter_mut().for_each(|one| one.sigma = 0.0);
            }
            let found = against(&now, &fits[1], &model, &settings, &mut |_| ()).unwrap();
            found.departures.len() + found.wiring.len() > 0
        };
        (0..pairs).filter(has_some).count()
    }

    /// One in a hundred: of 120 pairs 1.2, five or more with a probability of 0.8 %. A model that counts as exact makes more.
    #[test]
    #[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
    fn the_errors_of_a_model_are_no_departures() {
        let (known, exact) = (false_alarms(120, false), false_alarms(120, true));
        println!("{known} and {exact} of 120");
        assert!(known < 5 && exact > 2 * known, "{known} {exact}");
    }

    #[test]
    fn a_monitor_that_has_died_is_said() {
        let ring = ring();
        let before = measured(&ring, &machine(&ring, 21), NOISE, 3);
        let settings = Settings::default();
        let model = Believed::of(&before, &[], &fit(&before, &settings, &mut |_| ()).unwrap());
        let mut now = before.clone();
        now.matrix.row_mut(5).fill(0.0);
        let straightened = Straightened::of(&now, &settings, &mut |_| ()).unwrap();
        let found = against(&now, &straightened.fit, &model, &settings, &mut |_| ()).unwrap();
        assert_eq!(found.wiring, [Wiring::MonitorsDead(vec![5])]);
        assert_eq!(found.departures, []);
    }

    #[test]
    fn a_value_that_is_not_there_is_said() {
        let ring = ring();
        let folder = measured(&ring, &machine(&ring, 1), NOISE, 3);
        let fitted = fit(&folder, &Settings::default(), &mut |_| ()).unwrap();
        let mut model = Believed::of(&folder, &[], &fitted);
        let count = model.values.len();
        let refused = model.take_out("x_BPM.999").unwrap_err().to_string();
        assert_eq!(refused, format!("x_BPM.999: the model has no such value, of {count}"));
        model.values.push(Value { kind: "bpm_gain".into(), at: "x_BPM.999".into(), value: 1.0, sigma: 0.0 });
        let refused = against(&folder, &fitted, &model, &Settings::default(), &mut |_| ()).unwrap_err();
        assert_eq!(refused.to_string(), "the model has bpm_gain at x_BPM.999, ring has none");
    }
}
