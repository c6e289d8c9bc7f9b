//! Experiment design: how well one more campaign of the same length would separate two causes.
//!
//! The expected `ln` Bayes factor of the true cause over its rival ([`expected`]), from the whitened signatures of the present and
//! the new campaign together, all vars adapting.

use nalgebra::{DMatrix, DVector};
use twin::{Drives, Machine, Quadrupole, Signatures};

use super::data::Data;
use super::fit::{FitError, Fitted};
use super::scan::expected;
use super::term::Term;

/// What a possible measurement changes of the present one.
#[derive(Debug, Clone, PartialEq)]
pub enum Change {
    /// Nothing.
    Same,
    /// All corrector settings by a factor.
    Settings(f64),
    /// Only these correctors are used, by their index.
    Correctors(Vec<usize>),
    /// Another machine or another time in the cycle, or the RF frequency in frames of the correctors: more than settings one after the other.
    Machine,
}

/// One possible measurement.
#[derive(Debug, Clone)]
pub struct Proposal {
    /// What it changes.
    pub change: Change,
    /// Its description, to follow "A second campaign".
    pub what: String,
    /// Expected `ln` Bayes factor between the two causes, present and new campaign together.
    pub separation: f64,
}

/// The possible measurements for two causes, best first, and the separation expected of the present campaign.
#[derive(Debug, Clone)]
pub struct Menu {
    /// Expected of the present campaign.
    pub present: f64,
    /// Possible measurements.
    pub proposals: Vec<Proposal>,
}

/// Change of a family's gradients that is tried [1]: tunes change by some 0.05.
const RETUNE: f64 = 0.01;
/// RF offset that is tried [1], as in a dispersion measurement.
const RF_STEP: f64 = 4e-4;
/// Rigidity of an earlier moment of the cycle, relative.
const EARLIER: f64 = 0.5;

/// Derivatives of the whitened data of one campaign.
struct Derivatives {
    jacobian: DMatrix<f64>,
    one: DVector<f64>,
    other: Option<DVector<f64>>,
}

impl Menu {
    /// For a cause of some amplitude and its rival (another cause, or none), beside a fit.
    pub fn from_causes(
        data: &Data,
        fitted: &Fitted,
        one: (&Term, f64),
        other: Option<&Term>,
    ) -> Result<Self, FitError> {
        let sigma = &fitted.units.sigma;
        let of_recording = |campaign: usize| {
            let (machine, drives) = fitted.machine(data, campaign)?;
            let weight = data.momentum / data.campaign(campaign).momentum;
            Derivatives::from_machine(data.campaign(campaign), (&machine, &drives), sigma, (one.0, other), weight)
        };
        let present: Vec<Derivatives> = (0..data.count()).map(of_recording).collect::<Result<_, _>>()?;
        let (machine, drives) = fitted.machine(data, 0)?;
        let amplitude = one.1 / one.0.kind.prior_scale().unwrap_or(1.0);
        let free = [Some(one.0), other].map(|term| term.is_some_and(|term| !term.kind.is_switch()));
        let mut proposals = Vec::new();
        for Scenario { what, change, machine, drives, weight } in scenarios(data, &machine, &drives, one.0) {
            // a machine that would lose its beam is not proposed
            let new = Derivatives::from_machine(data, (&machine, &drives), sigma, (one.0, other), weight);
            let Ok(new) = new else { continue };
            let both: Vec<&Derivatives> = present.iter().chain([&new]).collect();
            proposals.push(Proposal { what, change, separation: separation(&both, amplitude, free) });
        }
        proposals.sort_by(|a, b| b.separation.total_cmp(&a.separation));
        Ok(Self { present: separation(&present.iter().collect::<Vec<_>>(), amplitude, free), proposals })
    }
}

impl Derivatives {
    /// `sigma`: standard deviations of the vars; `weight`: size of the cause over its present size.
    fn from_machine(
        data: &Data,
        (machine, drives): (&Machine, &Drives),
        sigma: &DVector<f64>,
        (one, other): (&Term, Option<&Term>),
        weight: f64,
    ) -> Result<Self, FitError> {
        let machine = machine.on_orbit(&drives.orbit);
        let signatures = Signatures::of(&machine, drives)?;
        let data = &data.driven_by(drives);
        let of_vars = signatures.of_vars();
        let columns: Vec<_> = of_vars.iter().zip(sigma).map(|(s, sigma)| data.signature(s) * *sigma).collect();
        let column = |term: &Term| -> Result<DVector<f64>, FitError> {
            let weight = if term.kind.is_stray() { weight } else { 1.0 };
            let scale = weight * term.kind.prior_scale().unwrap_or(1.0);
            Ok(data.signature(&signatures.of_effect(term.kind, term.site)?) * scale)
        };
        Ok(Self { jacobian: DMatrix::from_columns(&columns), one: column(one)?, other: other.map(column).transpose()? })
    }
}

/// A possible measurement.
struct Scenario {
    what: String,
    change: Change,
    machine: Machine,
    drives: Drives,
    /// Of stray fields.
    weight: f64,
}

impl Scenario {
    fn new(what: impl Into<String>, change: Change, machine: &Machine, drives: Drives) -> Self {
        Self { what: what.into(), change, machine: machine.clone(), drives, weight: 1.0 }
    }
}

fn scenarios(data: &Data, machine: &Machine, drives: &Drives, one: &Term) -> Vec<Scenario> {
    let ring = machine.ring();
    let retuned = |supply: usize, factor: f64| {
        let factor_of = |q: &Quadrupole| if q.supply == Some(supply) { factor } else { 1.0 };
        machine.with_strengths(&ring.quadrupoles.iter().map(factor_of).collect::<Vec<_>>())
    };
    let mut all = vec![Scenario::new("with the same settings", Change::Same, machine, drives.clone())];
    let doubled = Drives { kick: &drives.kick * 2.0, ..drives.clone() };
    all.push(Scenario::new("with twice the corrector settings", Change::Settings(2.0), machine, doubled));
    for (supply, family) in ring.supplies.iter().enumerate() {
        for (word, factor) in [("raised", 1.0 + RETUNE), ("lowered", 1.0 - RETUNE)] {
            let what = format!("with {} {word} by {:.0} %", family.name, RETUNE * 100.0);
            all.push(Scenario::new(what, Change::Machine, &retuned(supply, factor), drives.clone()));
        }
    }
    let alternating = DVector::from_fn(drives.rf_offset.len(), |i, _| if i % 2 == 0 { RF_STEP } else { -RF_STEP });
    let stepped = Drives { rf_offset: alternating, ..drives.clone() };
    let what = format!("with the RF frequency stepped by ±{RF_STEP:.0e} in every frame");
    all.push(Scenario::new(what, Change::Machine, machine, stepped));
    if let Some((idle, others)) = other_correctors(data, drives) {
        let change = Change::Correctors(idle);
        all.push(Scenario::new("with the correctors that were not used", change, machine, others));
    }
    if one.kind.is_stray() {
        let stronger = Drives { kick: &drives.kick / EARLIER, ..drives.clone() };
        let what = "earlier in the cycle, at half the momentum, where a stray field has twice the effect".to_owned();
        let weight = 1.0 / EARLIER;
        all.push(Scenario { weight, ..Scenario::new(what, Change::Machine, machine, stronger) });
    }
    all
}

/// The same frames with the correctors that were never powered, in turn.
fn other_correctors(data: &Data, drives: &Drives) -> Option<(Vec<usize>, Drives)> {
    let driven = data.driven_correctors();
    let idle: Vec<usize> = (0..drives.kick.ncols()).filter(|c| !driven.contains(c)).collect();
    if idle.is_empty() {
        return None;
    }
    let mut kick = DMatrix::zeros(drives.kick.nrows(), drives.kick.ncols());
    for (i, &c) in driven.iter().enumerate() {
        let mut column = kick.column_mut(idle[i % idle.len()]);
        column += drives.kick.column(c);
    }
    Some((idle, Drives { kick, ..drives.clone() }))
}

/// Expected `ln` Bayes factor of the first cause over the other.
fn separation(campaigns: &[&Derivatives], amplitude: f64, free: [bool; 2]) -> f64 {
    let p = campaigns[0].jacobian.ncols();
    let mut normal = DMatrix::identity(p, p);
    let (mut with_one, mut with_other) = (DVector::zeros(p), DVector::zeros(p));
    let (mut one, mut other, mut both) = (0.0, 0.0, 0.0);
    for campaign in campaigns {
        let back = campaign.jacobian.transpose();
        normal += &back * &campaign.jacobian;
        with_one += &back * &campaign.one;
        one += campaign.one.norm_squared();
        if let Some(rival) = &campaign.other {
            with_other += &back * rival;
            other += rival.norm_squared();
            both += rival.dot(&campaign.one);
        }
    }
    let Some(factor) = normal.cholesky() else { return 0.0 };
    let taken = factor.solve(&with_one);
    let (h, c) = (one - with_one.dot(&taken), both - with_other.dot(&taken));
    let rival = other - with_other.dot(&factor.solve(&with_other));
    expected(amplitude, [h, c, rival], free)
}
