//! What a fit leaves over: of the lattice or of the instruments.
//!
//! The lattice's side may have an integrated gradient and an integrated skew gradient [1/m] in the middle of every quadrupole, dipole and sextupole:
//! a single magnet of a group, a gradient in a dipole, the orbit in a sextupole. Their amplitudes `a` are normal with a width `W` a kind,
//! learnt from
//!
//! `ln evidence = g (H + W^-2)^-1 g/2 - ln det(1 + W H W)/2`,
//!
//! `g` the slope and `H` the curvature of `ln` likelihood, without what the unknowns of the fit can follow. The instruments' side may
//! have residuals of its own size in each row and each column.
//!
//! Either is learnt without a ninth of the matrix, some monitors by some correctors, and judged by what it gains there: `ln` likelihood of
//! Student's distribution, summed over all nine parts. The lattice is learnt without any element of these monitors and correctors. So more
//! parameters gain nothing by themselves.

use nalgebra::{Cholesky, DMatrix, DVector};

use crate::about::About;
use crate::error::MeasuredError;
use crate::fit::Fit;
use crate::folder::Folder;
use crate::missed::Missed;
use crate::model::Model;
use crate::unknowns::Kind;

/// Parts of the rows, and of the columns.
const PARTS: usize = 3;
/// Widths of the amplitudes that are tried [1/m]; the first one is none.
const WIDTHS: [f64; 7] = [1e-8, 3e-5, 1e-4, 3e-4, 1e-3, 3e-3, 1e-2];
/// Rounds of the size of an instrument's errors: with two degrees of freedom each grows by a factor of 1.7 at most.
const ROUNDS: usize = 30;
/// The least size: an instrument without any error is one without elements.
const LEAST: f64 = 1e-3;
/// One side is told where it gains this much [nat] ...
const GAINS: f64 = 10.0;
/// ... and so many times what the other one gains.
const MORE: f64 = 2.0;
/// `ln` Bayes factor from which on a term of the lattice is named, paid for the choice among all [nat].
const NAMED: f64 = 5.0;
/// Terms that are named at most.
const MOST: usize = 12;

/// Where what is left over lies.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Verdict {
    /// At instruments.
    Measurement,
    /// In the lattice.
    Lattice,
    /// Neither is clear.
    Neither,
}

/// What one side gains on elements that it was not learnt from.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Gain {
    /// `ln` likelihood [nat].
    pub log_likelihood: f64,
    /// Share of the sum of squares over the learnt error that is taken, or that is more than the instruments' usual.
    pub share: f64,
}

/// A term that the lattice lacks.
#[derive(Debug, Clone, PartialEq)]
pub struct Term {
    /// `stray_gradient`, `dipole_gradient` or `stray_skew_gradient`.
    pub kind: &'static str,
    /// Magnet.
    pub at: String,
    /// Row of the lattice.
    pub row: usize,
    /// Integrated gradient [1/m].
    pub amplitude: f64,
    /// Its standard deviation.
    pub sigma: f64,
    /// `ln` Bayes factor, paid for the choice among all terms [nat].
    pub log_evidence_gain: f64,
}

/// Both sides.
#[derive(Debug, Clone, PartialEq)]
pub struct Sides {
    /// Gradients and skew gradients together.
    pub lattice: Gain,
    /// Skew gradients alone.
    pub skew: Gain,
    /// Rows and columns with errors of their own size.
    pub instruments: Gain,
    /// Terms of the lattice, in the order in which they were found: of all where it is the lattice's side, of skew gradients where only these gain.
    pub terms: Vec<Term>,
}

impl Sides {
    /// True where skew gradients alone explain elements that they were not learnt from.
    pub fn lacks_skew(&self) -> bool {
        self.skew.log_likelihood > GAINS
    }

    /// Which side it is.
    pub fn verdict(&self) -> Verdict {
        let (lattice, instruments) = (self.lattice.log_likelihood, self.instruments.log_likelihood);
        if lattice > GAINS.max(MORE * instruments) {
            Verdict::Lattice
        } else if instruments > GAINS.max(MORE * lattice) {
            Verdict::Measurement
        } else {
            Verdict::Neither
        }
    }
}

/// Both sides of what a fit leaves over.
///
/// # Errors
/// [`MeasuredError`].
pub fn sides(folder: &Folder, fitted: &Fit, model: &Model) -> Result<Sides, MeasuredError> {
    // what the unknowns can follow as they like tells nothing
    if fitted.elements <= fitted.unknowns.len() {
        let none = Gain { log_likelihood: 0.0, share: 0.0 };
        return Ok(Sides { lattice: none, skew: none, instruments: none, terms: Vec::new() });
    }
    let rows: Vec<usize> = magnets(folder);
    let left = Left::of(folder, fitted, model, &rows)?;
    let (lattice, skew) = (left.held_out([true, true]), left.held_out([false, true]));
    let mut sides = Sides { lattice, skew, instruments: left.instruments(), terms: Vec::new() };
    let has_skew = fitted.unknowns.iter().any(|one| matches!(one.kind, Kind::Skew(_)));
    if sides.verdict() == Verdict::Lattice {
        sides.terms = left.terms(folder, &rows, 0);
    } else if !has_skew && sides.lacks_skew() {
        sides.terms = left.terms(folder, &rows, rows.len());
    }
    Ok(sides)
}

/// Rows of quadrupoles, dipoles and sextupoles.
fn magnets(folder: &Folder) -> Vec<usize> {
    let is_one = |row: &usize| {
        let one = &folder.lattice[*row];
        one.k1 != 0.0 || one.bend != 0.0 || one.half_k2 != 0.0
    };
    (0..folder.lattice.len()).filter(is_one).collect()
}

/// What is left over of each element that counts.
struct Left<'f> {
    fitted: &'f Fit,
    /// Row and column.
    places: Vec<[usize; 2]>,
    /// Parts of row and column.
    parts: Vec<[usize; 2]>,
    /// Slope of `ln` likelihood [1/mm] and what each element says [1/mm^2].
    slope: DVector<f64>,
    information: DVector<f64>,
    /// Patterns of the terms without what the unknowns can follow [mm m], columns terms: gradients, then skew gradients.
    patterns: DMatrix<f64>,
}

impl<'f> Left<'f> {
    fn of(folder: &Folder, fitted: &'f Fit, model: &Model, rows: &[usize]) -> Result<Self, MeasuredError> {
        let middles: Vec<f64> =
            rows.iter().map(|&row| folder.lattice[row].s + folder.lattice[row].length / 2.0).collect();
        let data = &fitted.data;
        let (rows, columns) = data.sigma.shape();
        let all = (0..columns).flat_map(|column| (0..rows).map(move |row| [row, column]));
        let places: Vec<[usize; 2]> = all.filter(|&[row, column]| data.sigma[(row, column)].is_finite()).collect();
        let counted = |values: &DMatrix<f64>| {
            DVector::from_iterator(places.len(), places.iter().map(|&[row, column]| values[(row, column)]))
        };
        let slope = data.weight(&fitted.missed, &fitted.residual).component_mul(&fitted.residual);
        let information = data.information(&fitted.missed);
        let prediction = model.predict(&fitted.unknowns, &fitted.values)?;
        let about = About::of(&fitted.unknowns, prediction, slope.clone(), information.clone())?;
        let terms = model.by_thin_gradients(&fitted.unknowns, &fitted.values, &middles)?;
        let patterns: Vec<DVector<f64>> =
            terms.iter().flatten().map(|pattern| counted(&about.projected(pattern))).collect();
        Ok(Self {
            fitted,
            parts: places.iter().map(|place| place.map(|line| line % PARTS)).collect(),
            slope: counted(&slope),
            information: counted(&information),
            patterns: DMatrix::from_columns(&patterns),
            places,
        })
    }

    /// Slope and curvature of the terms by elements of a part of the rows and a part of the columns.
    fn score(&self, part: [usize; 2]) -> (DVector<f64>, DMatrix<f64>) {
        let of_part: Vec<usize> = (0..self.places.len()).filter(|&one| self.parts[one] == part).collect();
        let patterns = self.patterns.select_rows(&of_part);
        let mut weighted = patterns.clone();
        weighted.row_iter_mut().zip(&of_part).for_each(|(mut row, &one)| row *= self.information[one]);
        (patterns.tr_mul(&self.slope.select_rows(&of_part)), patterns.tr_mul(&weighted))
    }

    /// What terms of some kinds, gradients and skew gradients, gain where they were not learnt.
    fn held_out(&self, kinds: [bool; 2]) -> Gain {
        let scores: Vec<_> = (0..PARTS * PARTS).map(|one| self.score([one / PARTS, one % PARTS])).collect();
        let terms = self.patterns.ncols();
        let mut predicted = DVector::zeros(self.places.len());
        for part in 0..PARTS * PARTS {
            let mut sum = (DVector::zeros(terms), DMatrix::zeros(terms, terms));
            for (one, (slope, curvature)) in scores.iter().enumerate() {
                if one / PARTS != part / PARTS && one % PARTS != part % PARTS {
                    sum = (sum.0 + slope, sum.1 + curvature);
                }
            }
            let amplitudes = learnt(&sum.0, &sum.1, kinds);
            let out = (0..self.places.len()).filter(|&one| self.parts[one] == [part / PARTS, part % PARTS]);
            for one in out {
                predicted[one] = self.patterns.row(one).tr_dot(&amplitudes);
            }
        }
        self.gain(&predicted)
    }

    /// What a prediction of the residuals gains.
    fn gain(&self, predicted: &DVector<f64>) -> Gain {
        let (mut log_likelihood, mut squares, mut left) = (0.0, 0.0, 0.0);
        for (&[row, column], predicted) in self.places.iter().zip(predicted) {
            let residual = self.fitted.residual[(row, column)];
            let sigma = self.fitted.data.sigma[(row, column)];
            let missed = &self.fitted.missed[self.fitted.data.block[(row, column)]];
            log_likelihood +=
                missed.log_likelihood(sigma, residual - predicted) - missed.log_likelihood(sigma, residual);
            squares += (residual / missed.spread(sigma)).powi(2);
            left += ((residual - predicted) / missed.spread(sigma)).powi(2);
        }
        Gain { log_likelihood, share: 1.0 - left / squares }
    }

    /// What rows and columns with errors of their own size gain where these were not learnt.
    fn instruments(&self) -> Gain {
        let offs: Vec<Off> = self.places.iter().map(|&place| Off::of(self.fitted, place)).collect();
        let (mut log_likelihood, mut squares, mut more) = (0.0, 0.0, 0.0);
        for part in (0..PARTS * PARTS).map(|one| [one / PARTS, one % PARTS]) {
            let (rows, columns) = self.fitted.residual.shape();
            let mut sizes = [DVector::from_element(rows, 1.0), DVector::from_element(columns, 1.0)];
            for _ in 0..3 {
                for side in 0..2 {
                    sizes[side] = self.sizes(&offs, part, &sizes, side);
                }
            }
            let out = (0..offs.len()).filter(|&one| self.parts[one] == part);
            for (off, [row, column]) in out.map(|one| (&offs[one], self.places[one])) {
                let size = sizes[0][row] * sizes[1][column];
                log_likelihood += off.log_likelihood(size) - off.log_likelihood(1.0);
                squares += off.off.powi(2);
                more += off.off.powi(2) * (1.0 - size.powi(-2)).max(0.0);
            }
        }
        Gain { log_likelihood, share: more / squares }
    }

    /// Sizes of the errors of each row (side 0) or column (side 1) beside those of the other, without a part: 1 unless its own size gains more
    /// than its price, that of one number learnt from the elements of the line and that of the choice among all lines.
    fn sizes(&self, offs: &[Off], part: [usize; 2], sizes: &[DVector<f64>; 2], side: usize) -> DVector<f64> {
        let mut of_line: Vec<Vec<(&Off, f64)>> = vec![Vec::new(); sizes[side].len()];
        let known = (0..offs.len()).filter(|&one| self.parts[one] != part);
        for (off, place) in known.map(|one| (&offs[one], self.places[one])) {
            of_line[place[side]].push((off, sizes[1 - side][place[1 - side]]));
        }
        let lines = (sizes[0].len() + sizes[1].len()) as f64;
        let of = |line: &Vec<(&Off, f64)>| {
            let size = size(line);
            let gain = |(off, other): &(&Off, f64)| off.log_likelihood(size * other) - off.log_likelihood(*other);
            let price = 0.5 * (line.len().max(1) as f64).ln() + lines.ln();
            if line.iter().map(gain).sum::<f64>() > price { size } else { 1.0 }
        };
        DVector::from_iterator(of_line.len(), of_line.iter().map(of))
    }

    /// Terms from a number on, one after the other, the best first, each beside those before it.
    fn terms(&self, folder: &Folder, rows: &[usize], from: usize) -> Vec<Term> {
        let count = self.patterns.ncols();
        let (mut slope, mut curvature) = (DVector::zeros(count), DMatrix::zeros(count, count));
        for part in 0..PARTS * PARTS {
            let (more, further) = self.score([part / PARTS, part % PARTS]);
            (slope, curvature) = (slope + more, curvature + further);
        }
        let width = WIDTHS[WIDTHS.len() - 1];
        let mut all = Vec::new();
        while all.len() < MOST {
            let evidence = |one: usize| {
                let (pull, power) = (slope[one] * width, curvature[(one, one)] * width * width);
                0.5 * pull * pull / (1.0 + power) - 0.5 * power.ln_1p() - (count as f64).ln()
            };
            let best = (from..count).max_by(|&a, &b| evidence(a).total_cmp(&evidence(b)));
            let Some(best) = best.filter(|&best| evidence(best) > NAMED) else { break };
            let power = curvature[(best, best)] + width.powi(-2);
            let row = rows[best % rows.len()];
            let kind = match (best < rows.len(), folder.lattice[row].bend != 0.0) {
                (true, true) => "dipole_gradient",
                (true, false) => "stray_gradient",
                (false, _) => "stray_skew_gradient",
            };
            let (amplitude, sigma) = (slope[best] / power, power.sqrt().recip());
            let log_evidence_gain = evidence(best);
            all.push(Term { kind, at: folder.element(row), row, amplitude, sigma, log_evidence_gain });
            // what the others have left when this one adapts
            let column = curvature.column(best).into_owned();
            slope -= &column * amplitude;
            curvature -= &column * column.transpose() / power;
        }
        all
    }
}

/// Most probable amplitudes of terms of some kinds, with the widths that the evidence likes best.
fn learnt(slope: &DVector<f64>, curvature: &DMatrix<f64>, kinds: [bool; 2]) -> DVector<f64> {
    let mut best = (0.0, [WIDTHS[0]; 2], DVector::zeros(slope.len()));
    for kind in (0..2).filter(|&kind| kinds[kind]) {
        let held = best.1;
        for width in &WIDTHS[1..] {
            let mut widths = held;
            widths[kind] = *width;
            if let Some((evidence, amplitudes)) = evidence(slope, curvature, widths)
                && evidence > best.0
            {
                best = (evidence, widths, amplitudes);
            }
        }
    }
    best.2
}

/// `ln` evidence of terms with a width a kind [1/m], and their most probable amplitudes.
fn evidence(slope: &DVector<f64>, curvature: &DMatrix<f64>, widths: [f64; 2]) -> Option<(f64, DVector<f64>)> {
    let n = slope.len();
    let width = DVector::from_fn(n, |one, _| widths[usize::from(one >= n / 2)]);
    let mut inner = DMatrix::from_fn(n, n, |i, j| width[i] * curvature[(i, j)] * width[j]);
    for one in 0..n {
        inner[(one, one)] += 1.0;
    }
    let factor = Cholesky::new(inner)?;
    let pull = slope.component_mul(&width);
    let moved = factor.solve(&pull);
    let half_determinant = factor.l_dirty().diagonal().iter().map(|one| one.ln()).sum::<f64>();
    Some((0.5 * pull.dot(&moved) - half_determinant, moved.component_mul(&width)))
}

/// Most probable size of the errors of some elements, beside the size that each has already.
fn size(line: &[(&Off, f64)]) -> f64 {
    let mut size = 1.0;
    for _ in 0..ROUNDS {
        let counted = line.iter().map(|(off, other)| off.weight(size * other) * (off.off / other).powi(2));
        size = (counted.sum::<f64>() / line.len().max(1) as f64).sqrt().max(LEAST);
    }
    size
}

/// One element's residual, in its errors.
struct Off {
    /// Over its scale.
    off: f64,
    missed: Missed,
}

impl Off {
    fn of(fitted: &Fit, [row, column]: [usize; 2]) -> Self {
        let missed = fitted.missed[fitted.data.block[(row, column)]];
        let off = fitted.residual[(row, column)] / missed.spread(fitted.data.sigma[(row, column)]);
        Self { off, missed: Missed { scale: 1.0, ..missed } }
    }

    /// `ln` likelihood where errors are some times as large.
    fn log_likelihood(&self, size: f64) -> f64 {
        self.missed.log_likelihood(0.0, self.off / size) - size.ln()
    }

    /// What the element counts of its square over its own size.
    fn weight(&self, size: f64) -> f64 {
        self.missed.weight(0.0, self.off / size)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fit::{Settings, fit};
    use crate::folder::Group;
    use crate::testing::{NOISE, machine, measured, normal, ring};
    use twin::Rf;

    /// A ring with a defect of the lattice: thin gradients and skew gradients [1/m] in the middle of rows, whose response is to first order.
    /// Quadrupoles are fitted as two families, so that none beside the place can take the effect.
    fn with_terms(seed: u64, terms: &[(usize, f64, bool)]) -> Folder {
        let mut ring = ring();
        let of = |name: &str| (0..ring.lattice.len()).filter(|&row| ring.lattice[row].name == name).collect();
        let [focusing, defocusing]: [Vec<usize>; 2] = [of("QF"), of("QD")];
        let groups = &mut ring.meta.reference_fit.as_mut().unwrap().fit_parameters;
        groups.retain(|group| group.field != "K");
        groups.extend([focusing, defocusing].map(|elements| Group { elements, field: "K".into() }));
        let truth = machine(&ring, seed);
        let mut folder = measured(&ring, &truth, NOISE, 500 + seed);
        for &(row, amplitude, is_skew) in terms {
            let middle = ring.lattice[row].s + ring.lattice[row].length / 2.0;
            let patterns = truth.0.by_thin_gradients(&truth.1, &truth.2, &[middle]).unwrap();
            let change = &patterns[usize::from(is_skew)][0] * amplitude;
            let columns = folder.matrix.ncols();
            folder.matrix += change.columns(0, columns);
            *folder.dispersion.as_mut().unwrap() += change.column(columns);
        }
        folder
    }

    fn found(folder: &Folder) -> Sides {
        let fitted = fit(folder, &Settings::default(), &mut |_| ()).unwrap();
        sides(folder, &fitted, &Model::of(folder, &fitted.groups, Rf::FixedFrequency).unwrap()).unwrap()
    }

    #[test]
    fn noise_is_of_neither_side() {
        for seed in 40..46 {
            let found = found(&with_terms(seed, &[]));
            assert_eq!(found.verdict(), Verdict::Neither, "{seed}: {found:?}");
        }
    }

    #[test]
    fn a_gradient_that_the_model_lacks_is_of_the_lattice() {
        // a dipole of the second cell and a quadrupole of the seventh
        let ring = ring();
        let of = |name: &str| -> Vec<usize> {
            (0..ring.lattice.len()).filter(|&row| ring.lattice[row].name == name).collect()
        };
        let (bend, quadrupole) = (of("B")[1], of("QF")[6]);
        for (seed, row, is_skew, kind) in [
            (50, bend, false, "dipole_gradient"),
            (51, bend, true, "stray_skew_gradient"),
            (52, quadrupole, true, "stray_skew_gradient"),
        ] {
            let found = found(&with_terms(seed, &[(row, 0.01, is_skew)]));
            assert_eq!(found.verdict(), Verdict::Lattice, "{seed}: {found:?}");
            let first = &found.terms[0];
            assert_eq!((first.kind, &first.at), (kind, &ring.element(row)), "{seed}: {found:?}");
            assert!((first.amplitude - 0.01).abs() < 4.0 * first.sigma, "{seed}: {first:?}");
        }
    }

    #[test]
    fn instruments_with_errors_of_their_own_are_of_the_measurement() {
        for seed in 60..64 {
            let mut noisy = with_terms(seed, &[]);
            let mut normal = normal(seed);
            noisy.matrix.row_mut(5).iter_mut().for_each(|one| *one += 10.0 * NOISE * normal());
            noisy.matrix.column_mut(17).iter_mut().for_each(|one| *one += 10.0 * NOISE * normal());
            let found_noisy = found(&noisy);
            assert_eq!(found_noisy.verdict(), Verdict::Measurement, "{seed}: {found_noisy:?}");
            // four monitors that read in steps of 100 um, as with bits that are stuck
            let mut stepped = with_terms(seed, &[]);
            for row in [3, 8, 15, 20] {
                stepped.matrix.row_mut(row).iter_mut().for_each(|one| *one = 0.1 * (*one / 0.1).round());
            }
            let found_stepped = found(&stepped);
            // few elements of a small ring: as large as the price of the lines in one of four
            assert_ne!(found_stepped.verdict(), Verdict::Lattice, "{seed}: {found_stepped:?}");
        }
    }
}
