//! What the model of a measured matrix lacks: wrong cables, what the RF holds, members that stand out of what their kind does everywhere, and instruments
//! whose readings nothing explains.
//!
//! The path from top to bottom: what is held is decided beside the fit ([`Share`]); everything that an ordinary ring has is fitted, family by family
//! ([`Hierarchy`]); members that stand out are released, and all is fitted anew ([`search`]); what was found has to predict elements that it was
//! not fitted to ([`HeldOut`]).

use nalgebra::DMatrix;
use twin::{Rf, median};

use crate::error::MeasuredError;
use crate::fit::{Fit, Settings};
use crate::folder::Folder;
use crate::held_out::HeldOut;
use crate::hierarchy::Hierarchy;
use crate::hold::Share;
use crate::model::Model;
use crate::search::{NAMED, Outlier, Rival, Search, search};
use crate::straight::DEAD;
use crate::unknowns::{self, Groups, Kind, name};
use crate::wiring::Wiring;

/// Searches, each about the fit with what the one before has found.
const SEARCHES: usize = 4;
/// An instrument is worse than others from this ratio on.
const WORSE: f64 = 2.5;
/// Probability beforehand of a wrong cable, and of another hold.
const RARE: f64 = 1e-3;
/// Scatters of an ordinary ring that are large.
const LARGE: f64 = 2.0;
/// Standard errors that held-out elements must gain.
const PREDICTS: f64 = 2.0;

/// What was found.
#[derive(Debug, Clone)]
pub struct Diagnosis {
    /// Of the held frequency.
    pub share: Share,
    /// What was found: of the whole ring, then the largest gain first.
    pub findings: Vec<Finding>,
    /// What is ordinary: families with their means and scatters.
    pub imperfections: Vec<Imperfection>,
    /// Amplitudes at which anything else would be named.
    pub limits: Vec<Limit>,
    /// Instruments whose readings are explained worse than others', the worst first.
    pub unexplained: Vec<Unexplained>,
    /// The fit as LOCO has it, and the fit with families and findings, on elements held out.
    pub held_out: [HeldOut; 2],
    /// The fit with families and findings.
    pub hierarchy: Hierarchy,
    /// One word.
    pub verdict: Verdict,
}

/// One word for a measurement.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Verdict {
    /// Nothing stands out.
    Consistent,
    /// What stands out is named.
    Identified,
    /// Something stands out, and its alternatives are as probable.
    Ambiguous,
    /// The fit did not end: nothing that is fitted is near the measurement.
    Unexplained,
}

impl Verdict {
    /// Its word in results.
    pub fn word(self) -> &'static str {
        match self {
            Self::Consistent => "consistent",
            Self::Identified => "identified",
            Self::Ambiguous => "ambiguous",
            Self::Unexplained => "unexplained",
        }
    }
}

/// What was found.
#[derive(Debug, Clone, PartialEq)]
pub enum What {
    /// A cable that was put right, or an instrument that was left out.
    Cable(Wiring),
    /// What the RF holds.
    Hold(Rf),
    /// A member of a family that stands out.
    Member(Kind),
}

/// Something that was found.
#[derive(Debug, Clone, PartialEq)]
pub struct Finding {
    /// What it is.
    pub what: What,
    /// Word of the kind.
    pub word: &'static str,
    /// Where, empty for the whole ring.
    pub at: String,
    /// Path length [m].
    pub s: Option<f64>,
    /// Distance from the mean of its family ([`Hierarchy::scale_of`]), share of a hold, 1 of a cable.
    pub amplitude: f64,
    /// Its standard deviation.
    pub sigma: f64,
    /// `ln` Bayes factor [nat].
    pub gain: f64,
    /// Probability beside its alternatives and nothing at all.
    pub probability: f64,
    /// Others that explain the same, the most probable first.
    pub alternatives: Vec<Alternative>,
}

/// Another explanation.
#[derive(Debug, Clone, PartialEq)]
pub struct Alternative {
    /// Word of the kind.
    pub word: &'static str,
    /// Where.
    pub at: String,
    /// Amplitude and its standard deviation.
    pub amplitude: [f64; 2],
    /// `ln` Bayes factor [nat].
    pub gain: f64,
    /// Its probability.
    pub probability: f64,
}

/// What a kind does everywhere.
#[derive(Debug, Clone, PartialEq)]
pub struct Imperfection {
    /// Word of the kind.
    pub word: &'static str,
    /// What the members share.
    pub class: String,
    /// Members.
    pub count: usize,
    /// Mean, from what is expected.
    pub mean: f64,
    /// Scatter about it.
    pub scatter: f64,
    /// That of an ordinary ring.
    pub ordinary: f64,
    /// Standard deviation of one member, median.
    pub sigma: f64,
}

impl Imperfection {
    /// True where the kind scatters by far more than in an ordinary ring.
    pub fn is_large(&self) -> bool {
        self.scatter > LARGE * self.ordinary
    }

    /// True for kicks that are off together by far more than they scatter in an ordinary ring: a kick constant, or the scale of the monitors.
    pub fn is_kick_constant(&self) -> bool {
        self.word == Kind::CorrectorGain(0).word() && self.mean.abs() > LARGE * self.ordinary
    }
}

/// What would be named.
#[derive(Debug, Clone, PartialEq)]
pub struct Limit {
    /// Word of the kind.
    pub word: &'static str,
    /// Where.
    pub at: String,
    /// Distance from the mean of its family at which it would be named.
    pub amplitude: f64,
    /// Standard deviation of an estimate of that distance by the data's errors and the scatter of the others.
    pub sigma: f64,
}

/// An instrument whose readings the model explains worse than those of the others.
#[derive(Debug, Clone, PartialEq)]
pub struct Unexplained {
    /// Its name.
    pub at: String,
    /// Rms of its residuals [mm].
    pub rms: f64,
    /// Its mean square over that of all other elements, by their weights.
    pub ratio: f64,
}

impl Diagnosis {
    /// Of a fitted measurement whose cables were put right; `progress` is told what is being done.
    ///
    /// # Errors
    /// [`MeasuredError`].
    pub fn of_fit(
        (folder, cables): (&Folder, &[Wiring]),
        fitted: &Fit,
        settings: &Settings,
        progress: &mut dyn FnMut(&str),
    ) -> Result<Self, MeasuredError> {
        progress("what the RF holds");
        let share = Share::of_fit(folder, fitted, settings, progress)?;
        let (fitted, settings) = &share.fitted(folder, fitted, settings, progress)?;
        let hierarchy = Hierarchy::of_fit(folder, fitted, settings, progress)?;
        let model = Model::of(folder, &hierarchy.groups, settings.rf)?;
        let (mut hierarchy, found) = released(hierarchy, folder, &model, fitted.has_ended, progress)?;
        progress("elements held out");
        let held_out = [as_loco(folder, fitted, settings)?, with_families(&hierarchy, fitted)?];
        // parts of the matrix that tell a value differently bear out no smaller error
        hierarchy.uncertainty.sigma.zip_apply(&held_out[1].jackknife, |sigma, scatter| *sigma = sigma.max(scatter));
        let cables = cables.iter().map(|cable| Finding::of_cable(folder, &hierarchy, cable));
        let members = found.outliers.iter().map(|outlier| Finding::of_outlier(folder, &hierarchy, outlier));
        let mut findings: Vec<Finding> = cables.chain(Finding::of_share(&share)).chain(members).collect();
        // what the whole ring does before what stands at a place
        let is_local = |finding: &Finding| !matches!(finding.what, What::Hold(_));
        findings.sort_by(|a, b| is_local(a).cmp(&is_local(b)).then(b.gain.total_cmp(&a.gain)));
        let verdict = verdict(fitted, &findings, &held_out);
        Ok(Self {
            imperfections: imperfections(&hierarchy),
            limits: limits(folder, &hierarchy, &found),
            unexplained: unexplained(folder, &hierarchy),
            share,
            findings,
            held_out,
            hierarchy,
            verdict,
        })
    }
}

/// Search and release until nothing more stands out, and all that is released does.
pub fn released(
    mut hierarchy: Hierarchy,
    folder: &Folder,
    model: &Model,
    has_ended: bool,
    progress: &mut dyn FnMut(&str),
) -> Result<(Hierarchy, Search), MeasuredError> {
    let mut found = Search { outliers: Vec::new(), limits: Vec::new() };
    // a fit that did not end is of no ring
    for _ in 0..if has_ended { SEARCHES } else { 0 } {
        progress("what stands out");
        let further = search(&hierarchy)?;
        found.limits = further.limits;
        if further.outliers.is_empty() {
            break;
        }
        found.outliers.extend(further.outliers);
        hierarchy = hierarchy.with_released(folder, model, &found.unknowns(), progress)?;
    }
    // what was found first may be explained by what was found after it
    loop {
        found.outliers = found.outliers.into_iter().map(|outlier| outlier.confirmed(&hierarchy)).collect();
        let count = found.outliers.len();
        found.outliers.retain(Outlier::stands_out);
        if found.outliers.len() == count {
            return Ok((hierarchy, found));
        }
        hierarchy = hierarchy.with_released(folder, model, &found.unknowns(), progress)?;
    }
}

/// A member must predict elements that it was not fitted to; cables and holds are in both predictions.
fn verdict(fitted: &Fit, findings: &[Finding], [before, after]: &[HeldOut; 2]) -> Verdict {
    let (gain, error) = after.gain_over(before);
    let is_named =
        |finding: &Finding| finding.is_named() && (!matches!(finding.what, What::Member(_)) || gain > PREDICTS * error);
    if !fitted.has_ended {
        Verdict::Unexplained
    } else if findings.iter().any(is_named) {
        Verdict::Identified
    } else if findings.is_empty() {
        Verdict::Consistent
    } else {
        Verdict::Ambiguous
    }
}

impl Finding {
    fn of_outlier(folder: &Folder, hierarchy: &Hierarchy, outlier: &Outlier) -> Self {
        let kind = hierarchy.unknowns[outlier.unknown].kind;
        let scale = hierarchy.scale_of(outlier.unknown);
        let alternative = |rival: &Rival| {
            let kind = hierarchy.unknowns[rival.unknown].kind;
            let (word, at) = (word(folder, &hierarchy.groups, kind), name(folder, &hierarchy.groups, kind));
            Alternative { word, at, amplitude: rival.amplitude, gain: rival.gain, probability: rival.probability }
        };
        Self {
            what: What::Member(kind),
            word: match kind {
                Kind::MonitorGain(_) if hierarchy.values[outlier.unknown].abs() < DEAD => "bpm_dead",
                Kind::CorrectorGain(_) if hierarchy.values[outlier.unknown].abs() < DEAD => "corrector_dead",
                _ => word(folder, &hierarchy.groups, kind),
            },
            at: name(folder, &hierarchy.groups, kind),
            s: Some(path_length(folder, &hierarchy.groups, kind)),
            amplitude: hierarchy.off_family(outlier.unknown) / scale,
            sigma: hierarchy.uncertainty.sigma[outlier.unknown] / scale.abs(),
            gain: outlier.gain,
            probability: outlier.probability,
            alternatives: outlier.alternatives.iter().map(alternative).collect(),
        }
    }

    /// Of a hold that is not the one that was believed.
    fn of_share(share: &Share) -> Option<Self> {
        let held = share.other()?;
        let (word, amplitude) = match held {
            Rf::FixedFrequency => ("fixed_rf_frequency", share.value),
            Rf::FixedMomentum => ("fixed_momentum", 1.0 - share.value),
        };
        let (gain, probability) = (share.gain, certain(share.gain));
        let (what, at, s) = (What::Hold(held), String::new(), None);
        Some(Self { what, word, at, s, amplitude, sigma: share.sigma(), gain, probability, alternatives: Vec::new() })
    }

    /// Of a cable, with half the sum of squares that it would leave.
    fn of_cable(folder: &Folder, hierarchy: &Hierarchy, cable: &Wiring) -> Self {
        let (word, at) = cable.named(folder);
        let gain = cable.squares(folder, &hierarchy.prediction.matrix, |row, column| {
            hierarchy.noise.blocks[hierarchy.data.block[(row, column)]].spread(folder.monitors[row].sigma)
        }) / 2.0;
        let (what, s, probability) = (What::Cable(cable.clone()), None, certain(gain));
        Self { what, word, at, s, amplitude: 1.0, sigma: 0.0, gain, probability, alternatives: Vec::new() }
    }

    /// True where it is named.
    pub fn is_named(&self) -> bool {
        self.probability >= NAMED
    }
}

/// Probability of something that is one in a thousand beforehand.
fn certain(gain: f64) -> f64 {
    1.0 / (1.0 + (RARE.recip().ln() - gain).exp())
}

/// Word of a kind at its place: a gradient in a dipole has one of its own.
pub fn word(folder: &Folder, groups: &Groups, kind: Kind) -> &'static str {
    match kind {
        Kind::Gradient(group) if folder.lattice[groups[2][group][0]].bend != 0.0 => "dipole_gradient",
        _ => kind.word(),
    }
}

/// Where something is [m].
fn path_length(folder: &Folder, groups: &Groups, kind: Kind) -> f64 {
    let middle = |row: usize| folder.lattice[row].s + 0.5 * folder.lattice[row].length;
    match kind {
        Kind::Strength(group) | Kind::Added(group) => middle(groups[0][group][0]),
        Kind::Skew(group) => middle(groups[1][group][0]),
        Kind::Gradient(group) => middle(groups[2][group][0]),
        Kind::Wiggler(group) | Kind::Moment(.., group) => middle(unknowns::middle(&groups[3][group])),
        Kind::MonitorGain(row) | Kind::MonitorCoupling(row) => middle(folder.monitors[row].at),
        Kind::CorrectorGain(column) | Kind::CorrectorCoupling(column) => middle(folder.correctors[column].at),
        Kind::RfScale | Kind::HeldFrequency => 0.0,
    }
}

fn imperfections(hierarchy: &Hierarchy) -> Vec<Imperfection> {
    let told = hierarchy.families.iter().filter(|family| family.has_members()).map(|family| {
        let width = hierarchy.unknowns[family.members[0]].width;
        let sigma = median(family.members.iter().map(|&member| hierarchy.uncertainty.sigma[member]));
        Imperfection {
            word: family.kind,
            class: family.class.clone(),
            count: family.members.len(),
            mean: family.mean(&hierarchy.off_priors()) * width,
            scatter: family.variance().sqrt() * width,
            ordinary: family.ordinary_scatter() * width,
            sigma: sigma.expect("it has members"),
        }
    });
    told.collect()
}

fn limits(folder: &Folder, hierarchy: &Hierarchy, found: &Search) -> Vec<Limit> {
    let limit = |&(unknown, [amplitude, sigma]): &(usize, [f64; 2])| {
        let kind = hierarchy.unknowns[unknown].kind;
        let scale = hierarchy.scale_of(unknown).abs();
        Limit {
            word: word(folder, &hierarchy.groups, kind),
            at: name(folder, &hierarchy.groups, kind),
            amplitude: amplitude / scale,
            sigma: sigma / scale,
        }
    };
    found.limits.iter().map(limit).collect()
}

/// The fit as LOCO has it on elements held out.
fn as_loco(folder: &Folder, fitted: &Fit, settings: &Settings) -> Result<HeldOut, MeasuredError> {
    let n = fitted.unknowns.len();
    let prediction = Model::of(folder, &fitted.groups, settings.rf)?.predict(&fitted.unknowns, &fitted.values)?;
    HeldOut::of_fit(
        (&fitted.data, &fitted.data),
        (&fitted.unknowns, &fitted.values, &prediction),
        (&DMatrix::identity(n, n), &fitted.noise),
    )
}

/// The fit with families and findings on elements held out.
fn with_families(hierarchy: &Hierarchy, fitted: &Fit) -> Result<HeldOut, MeasuredError> {
    HeldOut::of_fit(
        (&hierarchy.data, &fitted.data),
        (&hierarchy.unknowns, &hierarchy.values, &hierarchy.prediction),
        (&hierarchy.precision(), &hierarchy.noise),
    )
}

/// Monitors' rows and correctors' columns whose residuals are larger than those of the others.
fn unexplained(folder: &Folder, hierarchy: &Hierarchy) -> Vec<Unexplained> {
    let Hierarchy { data, residual, .. } = hierarchy;
    let squares =
        residual.component_mul(residual).component_mul(&data.precision(&hierarchy.noise.with_equal_monitors()));
    let (sum, elements) = (squares.sum(), data.elements() as f64);
    let judge = |at: String, squares: f64, residual: f64, n: usize| {
        let others = (sum - squares) / (elements - n as f64);
        Unexplained { at, rms: (residual / n.max(1) as f64).sqrt(), ratio: squares / n.max(1) as f64 / others }
    };
    let counted = |sigmas: &mut dyn Iterator<Item = &f64>| sigmas.filter(|sigma| sigma.is_finite()).count();
    let rows = (0..folder.monitors.len()).map(|row| {
        let count = counted(&mut data.sigma.row(row).iter());
        judge(folder.monitor(row), squares.row(row).sum(), residual.row(row).norm_squared(), count)
    });
    let columns = (0..folder.correctors.len()).map(|column| {
        let count = counted(&mut data.sigma.column(column).iter());
        judge(folder.corrector(column), squares.column(column).sum(), residual.column(column).norm_squared(), count)
    });
    let mut worst: Vec<Unexplained> = rows.chain(columns).filter(|one| one.ratio > WORSE).collect();
    worst.sort_by(|a, b| b.ratio.total_cmp(&a.ratio));
    worst
}
