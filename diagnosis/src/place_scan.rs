//! Place scan of a gradient: the `ln` Bayes factor of a thin one at every place of the ring, all unknowns of a fit adapting.
//!
//! The ring is cut into segments with one trial gradient in the middle of each, and into finer ones where it is likely.
//! With a prior uniform in `s`, the posterior of the place is `exp(ln Bayes factor)` times the length of the segment. It
//! assumes one gradient at one place in a model that is otherwise correct, and is of first order about the fit.

use core::convert::Infallible;

use twin::{Place, Thin};

use super::data::Data;
use super::fit::{FitError, Fitted};
use super::scan::{BATCH, Projection, SignatureScore, of_each};

/// Longest segment [m], and longest where the gradient may be.
const STEP: f64 = 0.5;
const FINE: f64 = 0.05;
/// Places within this `ln` Bayes factor of the best are cut more finely [nat]; the second limit, a share of the best, applies where
/// the best is small.
const BEHIND: f64 = 12.0;
const BEHIND_SHARE: f64 = 0.5;

/// A piece of the ring with one trial gradient.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Segment {
    /// Its middle along the beam [m].
    pub s: f64,
    /// Its length [m].
    pub length: f64,
    /// `ln` Bayes factor over none.
    pub log_bayes: f64,
    /// Most likely amplitude [1/m].
    pub amplitude: f64,
    place: Place,
}

/// A stretch of the ring; one across the start of the ring ends before it begins.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Interval {
    /// Where it begins [m].
    pub from_m: f64,
    /// Where it ends [m].
    pub to_m: f64,
}

/// A thin gradient at every place of the ring.
#[derive(Debug, Clone)]
pub struct PlaceScan {
    /// Normal or skew.
    pub kind: Thin,
    /// Where, along the beam.
    pub segments: Vec<Segment>,
}

impl PlaceScan {
    /// Scan the ring about a fit, one of its effects left out if the scan replaces it.
    ///
    /// # Errors
    /// [`FitError`].
    pub fn from_fit(data: &Data, fitted: &Fitted, left_out: Option<usize>, kind: Thin) -> Result<Self, FitError> {
        let unknown = left_out.and_then(|term| fitted.unknown(data, term)).map(|(at, _)| at);
        let projection =
            unknown.map_or_else(|| Ok(Projection::from_fit(fitted)), |at| Projection::without(fitted, at))?;
        let data = fitted.data(data);
        let machines = fitted.machines_on_orbit(data)?;
        let signatures = of_each(&machines)?;
        let scale = kind.kind().prior_scale().unwrap_or(1.0);
        // a gradient of the magnets, where that is what the scan replaces
        let of_kind = left_out.map_or_else(|| kind.kind(), |term| fitted.hypothesis.terms[term].kind);
        let judge = |segments: Vec<Segment>| -> Self {
            let of_batch = |batch: &[Segment]| {
                let columns = data.stacked_columns(batch.len(), |campaign, own, into| {
                    let scale = scale * data.scale(campaign, of_kind);
                    let signature = |at: &Segment| Ok(Some(signatures[campaign].of_thin(at.place, kind) * scale));
                    own.signatures::<Infallible>(into, batch.iter().map(signature))
                });
                let Ok(columns) = columns;
                projection.score(&columns).0
            };
            let scores: Vec<SignatureScore> = segments.chunks(BATCH).flat_map(of_batch).collect();
            let judged = |(segment, score): (Segment, SignatureScore)| {
                let (amplitude, log_bayes) = score.judged(false);
                Segment { log_bayes, amplitude: amplitude * scale, ..segment }
            };
            Self { kind, segments: segments.into_iter().zip(scores).map(judged).collect() }
        };
        let coarse = judge(segments(data));
        let finer = judge(coarse.likely().flat_map(|i| coarse.segments[i].split()).collect());
        Ok(coarse.with(finer))
    }

    /// Cells that are not far behind the first.
    fn likely(&self) -> impl Iterator<Item = usize> + '_ {
        let first = self.segments[self.peak()].log_bayes;
        let limit = first - BEHIND.min(BEHIND_SHARE * first.abs());
        (0..self.segments.len()).filter(move |&i| self.segments[i].log_bayes > limit)
    }

    /// The same with the likely segments replaced by finer ones.
    fn with(&self, finer: Self) -> Self {
        let likely: Vec<usize> = self.likely().collect();
        let kept = (0..self.segments.len()).filter(|i| !likely.contains(i));
        let mut segments: Vec<Segment> = kept.map(|i| self.segments[i]).chain(finer.segments).collect();
        segments.sort_by(|one, other| one.s.total_cmp(&other.s));
        Self { segments, ..*self }
    }

    /// The most likely segment.
    pub fn peak(&self) -> usize {
        let log_bayes = |i: usize| self.segments[i].log_bayes;
        (0..self.segments.len()).max_by(|&i, &j| log_bayes(i).total_cmp(&log_bayes(j))).unwrap_or(0)
    }

    /// The shortest stretches of the ring that hold a share of the posterior, in beam order.
    pub fn credible(&self, share: f64) -> Vec<Interval> {
        let log_bayes = |i: usize| self.segments[i].log_bayes;
        let largest = log_bayes(self.peak());
        let weight = |i: usize| (log_bayes(i) - largest).exp() * self.segments[i].length;
        let mut order: Vec<usize> = (0..self.segments.len()).collect();
        order.sort_by(|&i, &j| log_bayes(j).total_cmp(&log_bayes(i)));
        let wanted = share * order.iter().map(|&i| weight(i)).sum::<f64>();
        let (mut held, mut inside) = (0.0, vec![false; order.len()]);
        for i in order {
            if held >= wanted {
                break;
            }
            held += weight(i);
            inside[i] = true;
        }
        self.stretches(&inside)
    }

    /// Neighbours joined, across the start of the ring too.
    fn stretches(&self, inside: &[bool]) -> Vec<Interval> {
        let mut all: Vec<Interval> = Vec::new();
        for (i, segment) in self.segments.iter().enumerate().filter(|(i, _)| inside[*i]) {
            let (from_m, to_m) = (segment.s - 0.5 * segment.length, segment.s + 0.5 * segment.length);
            match all.last_mut().filter(|_| inside[i - 1]) {
                Some(last) => last.to_m = to_m,
                None => all.push(Interval { from_m, to_m }),
            }
        }
        if all.len() > 1 && inside[0] && inside.last() == Some(&true) {
            let first = all.remove(0);
            all.last_mut().expect("two less one").to_m = first.to_m;
        }
        all
    }
}

impl Segment {
    /// Finer ones in its place.
    fn split(self) -> Vec<Segment> {
        let start = self.s - 0.5 * self.length;
        cut(self.place.element, start, self.place.depth - 0.5 * self.length, self.length, FINE)
    }
}

/// The whole ring.
fn segments(data: &Data) -> Vec<Segment> {
    let elements = data.ring.elements.iter().enumerate().filter(|(_, element)| element.length > 0.0);
    elements.flat_map(|(at, element)| cut(at, element.s, 0.0, element.length, STEP)).collect()
}

/// Equal pieces, at most so long and not judged yet, of a part of an element that begins at `s`, `depth` from its entrance.
fn cut(element: usize, s: f64, depth: f64, length: f64, step: f64) -> Vec<Segment> {
    let count = (length / step).ceil().max(1.0);
    let piece = length / count;
    let interval = |i: usize| {
        let middle = (i as f64 + 0.5) * piece;
        let place = Place { element, depth: depth + middle };
        Segment { s: s + middle, length: piece, log_bayes: 0.0, amplitude: 0.0, place }
    };
    (0..count as usize).map(interval).collect()
}

#[cfg(test)]
mod tests {
    use nalgebra::DVector;

    use super::*;
    use crate::hypothesis::Hypothesis;
    use crate::testing::{simulated, template, whitened};
    use twin::Effect;

    #[test]
    fn the_scan_peaks_where_the_gradient_is() {
        let ring = template().0;
        // the vars of its neighbours imitate a normal gradient: it has to be larger, and its place is less certain
        let cases = [(Thin::Normal, "SLOT_C6", 0.08, 12.0), (Thin::Skew, "SLOT_E3", 0.01, 4.0)];
        for (thin, place, amplitude, widest) in cases {
            let effect = Effect::at(thin.kind(), place, amplitude, &ring).unwrap();
            let mut data = whitened(&ring, &simulated(&[1.0; 48], &[effect], &[], 7));
            let hypothesis = Hypothesis { terms: vec![effect.into()], ..Hypothesis::default() };
            let fitted = Fitted::from_guess(&data, &hypothesis, &DVector::zeros(48)).unwrap();
            let (machine, drives) = fitted.machine(&data, 0).unwrap();
            data.linearise_about(&machine, &drives.orbit).unwrap();
            let fitted = Fitted::from_guess(&data, &hypothesis, &fitted.u).unwrap();
            let scan = PlaceScan::from_fit(&data, &fitted, Some(0), thin).unwrap();
            let truth = ring.elements[ring.element(place).unwrap()].s;
            let peak = scan.segments[scan.peak()];
            let credible = scan.credible(0.95);
            let width: f64 = credible.iter().map(|one| one.to_m - one.from_m).sum();
            println!("{place} s {truth:.2}: peak {:.2}, {width:.2} m, {:.4} /m", peak.s, peak.amplitude);
            assert!(credible.iter().any(|one| (one.from_m - 1.0..one.to_m + 1.0).contains(&truth)), "{credible:?}");
            assert!(width < widest, "{credible:?}");
            // some three standard deviations
            assert!((peak.amplitude - amplitude).abs() < 0.3 * amplitude, "{}", peak.amplitude);
            let whole: f64 = scan.segments.iter().map(|segment| segment.length).sum();
            assert!((whole - ring.circumference).abs() < 1e-6, "{whole}");
        }
    }

    #[test]
    fn a_stretch_may_cross_the_start_of_the_ring() {
        let place = Place { element: 0, depth: 0.0 };
        let log_bayes = |i: usize| if [0, 1, 9].contains(&i) { 0.0 } else { -50.0 };
        let segment = |i| Segment { s: i as f64 + 0.5, length: 1.0, log_bayes: log_bayes(i), amplitude: 0.0, place };
        let scan = PlaceScan { kind: Thin::Normal, segments: (0..10).map(segment).collect() };
        assert_eq!(scan.credible(0.95), [Interval { from_m: 9.0, to_m: 2.0 }]);
    }
}
