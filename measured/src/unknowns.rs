//! What is fitted: magnets, and the instruments that see them.

use nalgebra::DVector;

use crate::derivative::Change;
use crate::folder::{Folder, Row};

/// One fitted number.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// Strength factor of a group of magnets, 1 as in the lattice.
    Strength(usize),
    /// Integrated skew gradient of each magnet of a group [1/m].
    Skew(usize),
    /// Integrated gradient of each magnet of a group beside its own [1/m].
    Gradient(usize),
    /// Integrated vertical focusing along a straight [1/m], as of a wiggler.
    Wiggler(usize),
    /// Moment of some order of what acts along a straight: the integral of the gradient [1/m^2] times that power of the distance from its middle [m].
    Moment(u8, Change, usize),
    /// Gradient of each magnet of a group beside its own, which is 0 or nearly so, all along it [1/m^2].
    Added(usize),
    /// Share of the orbit that a held RF frequency adds, 1 where it is held and 0 where the momentum is.
    HeldFrequency,
    /// What a monitor reads of its own plane: 1 if it is right, 0 if it is dead.
    MonitorGain(usize),
    /// What it reads of the other plane.
    MonitorCoupling(usize),
    /// A corrector's kick in its own plane over the one that is believed.
    CorrectorGain(usize),
    /// Its kick in the other plane over the same.
    CorrectorCoupling(usize),
    /// The step of the RF frequency over the one that is stated.
    RfScale,
}

/// What is fitted along so many straights, in the order of the unknowns: vertical focusing, a skew gradient, then first moments.
pub fn fields_along(straights: usize) -> impl Iterator<Item = Kind> {
    let kinds: [fn(usize) -> Kind; 5] = [
        Kind::Wiggler,
        |straight| Kind::Moment(0, Change::Skew, straight),
        |straight| Kind::Moment(1, Change::Normal, straight),
        |straight| Kind::Moment(1, Change::Vertical, straight),
        |straight| Kind::Moment(1, Change::Skew, straight),
    ];
    kinds.into_iter().flat_map(move |kind| (0..straights).map(kind))
}

impl Kind {
    /// Its word in results.
    pub fn word(self) -> &'static str {
        match self {
            Self::Strength(_) => "quadrupole_gradient",
            Self::Skew(_) | Self::Moment(0, Change::Skew, _) => "skew_gradient",
            Self::Gradient(_) => "stray_gradient",
            Self::Wiggler(_) => "wiggler_focusing",
            Self::Moment(_, Change::Normal, _) => "gradient_moment",
            Self::Moment(_, Change::Vertical, _) => "wiggler_moment",
            Self::Moment(_, Change::Skew, _) => "skew_gradient_moment",
            Self::Added(_) => "added_gradient",
            Self::HeldFrequency => "fixed_rf_frequency",
            Self::MonitorGain(_) => "bpm_gain",
            Self::MonitorCoupling(_) => "bpm_coupling",
            Self::CorrectorGain(_) => "corrector_gain",
            Self::CorrectorCoupling(_) => "corrector_coupling",
            Self::RfScale => "rf_scale",
        }
    }

    /// True of what the machine has, false of the instruments.
    pub fn is_of_machine(self) -> bool {
        match self {
            Self::Strength(_)
            | Self::Added(_)
            | Self::Skew(_)
            | Self::Gradient(_)
            | Self::Wiggler(_)
            | Self::Moment(..)
            | Self::HeldFrequency => true,
            Self::MonitorGain(_)
            | Self::MonitorCoupling(_)
            | Self::CorrectorGain(_)
            | Self::CorrectorCoupling(_)
            | Self::RfScale => false,
        }
    }

    /// Row of the monitor whose gain it is, 0, or coupling, 1.
    pub fn of_monitor(self) -> Option<(usize, usize)> {
        match self {
            Self::MonitorGain(row) => Some((row, 0)),
            Self::MonitorCoupling(row) => Some((row, 1)),
            _ => None,
        }
    }

    /// Column of the corrector whose gain it is, 0, or coupling, 1.
    pub fn of_corrector(self) -> Option<(usize, usize)> {
        match self {
            Self::CorrectorGain(column) => Some((column, 0)),
            Self::CorrectorCoupling(column) => Some((column, 1)),
            _ => None,
        }
    }

    /// Gradient of a magnet [1/m^2] whose own is `k1`, at a value of the unknown that it is of.
    pub fn gradient(self, k1: f64, value: f64) -> f64 {
        if matches!(self, Self::Added(_)) { k1 + value } else { k1 * value }
    }
}

/// One fitted number, with its prior.
#[derive(Debug, Clone, Copy)]
pub struct Unknown {
    /// What it is.
    pub kind: Kind,
    /// Expected beforehand.
    pub mean: f64,
    /// Its standard deviation.
    pub width: f64,
}

/// The shortest straight that may hold a wiggler [m].
const STRAIGHT: f64 = 1.0;

/// Magnets that share one factor: rows of the lattice.
pub type Magnets = Vec<usize>;

/// Groups of gradients, of skew gradients, of gradients beside those of the lattice, and straights that may focus along their length.
pub type Groups = [Vec<Magnets>; 4];

/// Prior standard deviations.
#[derive(Debug, Clone, Copy)]
pub struct Widths {
    /// Of a strength factor.
    pub strength: f64,
    /// Of an integrated skew gradient, and of an integrated gradient where the lattice has none [1/m].
    pub skew: f64,
    /// Of the integrated vertical focusing of a straight [1/m].
    pub wiggler: f64,
    /// Of the gain of a monitor and of a corrector.
    pub gain: f64,
    /// Of what either has of the other plane.
    pub coupling: f64,
}

impl Default for Widths {
    /// 3 % as for the vars of the Booster; 0.01 /m is a quadrupole of 1 /m rolled by 5 mrad; 0.1 /m is a wiggler of 2 m and 1.5 T at 1.5 GeV; gains as far off as those of old electronics, which no
    /// response can tell from a scale of all kicks; 5 % of the other plane is a roll of 50 mrad.
    fn default() -> Self {
        Self { strength: 0.03, skew: 0.01, wiggler: 0.1, gain: 0.2, coupling: 0.05 }
    }
}

/// Groups of gradients and of skew gradients: those of the reference fit, else every quadrupole and every dipole with a gradient by itself.
pub fn groups(folder: &Folder) -> Groups {
    let Some(reference) = &folder.meta.reference_fit else {
        return [magnets(folder, |row| row.k1 != 0.0), Vec::new(), Vec::new(), Vec::new()];
    };
    let of = |is_gradient: bool| {
        let groups = reference.fit_parameters.iter().filter(move |one| (one.field == "K") == is_gradient);
        groups.map(|one| distinct(&one.elements)).collect()
    };
    [of(true), of(false), Vec::new(), Vec::new()]
}

/// Length of some rows together [m].
pub fn length(folder: &Folder, rows: &[usize]) -> f64 {
    rows.iter().map(|&row| folder.lattice[row].length).sum()
}

/// The row in the middle of some.
pub fn middle(rows: &Magnets) -> usize {
    rows[rows.len() / 2]
}

fn distinct(rows: &[usize]) -> Magnets {
    let mut rows = rows.to_vec();
    rows.sort_unstable();
    rows.dedup();
    rows
}

/// Every magnet of some sort.
pub fn magnets(folder: &Folder, is_magnet: impl Fn(&Row) -> bool) -> Vec<Magnets> {
    let rows: Vec<usize> = (0..folder.lattice.len()).filter(|&row| is_magnet(&folder.lattice[row])).collect();
    cut(folder, &rows).map(<[usize]>::to_vec).collect()
}

/// Rows of each magnet: neighbouring ones of one name, with nothing of length between them, are one magnet.
fn cut<'r>(folder: &'r Folder, rows: &'r [usize]) -> impl Iterator<Item = &'r [usize]> {
    let is_one = |one: &usize, next: &usize| {
        folder.lattice[*one].name == folder.lattice[*next].name
            && folder.lattice[one + 1..*next].iter().all(|between| between.length == 0.0)
    };
    rows.chunk_by(is_one)
}

/// Rows of every straight in which a wiggler may stand, a metre and more of field-free rows: those of the name that the middle has.
pub fn straights(folder: &Folder) -> Vec<Magnets> {
    let is_free = |row: usize| {
        let Row { k1, bend, half_k2, .. } = folder.lattice[row];
        k1 == 0.0 && bend == 0.0 && half_k2 == 0.0
    };
    let count = folder.lattice.len();
    let Some(first) = (0..count).find(|&row| !is_free(row)) else { return Vec::new() };
    // the ring may begin within a straight
    let around: Vec<usize> = (first..count).chain(0..first).filter(|&row| folder.lattice[row].length > 0.0).collect();
    let length = |rows: &[usize]| length(folder, rows);
    let device = |rows: &[usize]| {
        let middle = (1..rows.len()).find(|&end| length(&rows[..end]) > 0.5 * length(rows)).unwrap_or(1) - 1;
        let name = |place: usize| &folder.lattice[rows[place]].name;
        let begin = (0..middle).rev().find(|&place| name(place) != name(middle)).map_or(0, |before| before + 1);
        let end = (middle..rows.len()).find(|&place| name(place) != name(middle)).unwrap_or(rows.len());
        rows[begin..end].to_vec()
    };
    let free = around.chunk_by(|&one, &next| is_free(one) == is_free(next)).filter(|rows| is_free(rows[0]));
    free.filter(|rows| length(rows) > STRAIGHT).map(device).collect()
}

/// What is fitted of a group of gradients: a factor, or a gradient that is added where the lattice has none, or less than a magnet without one may have.
fn of_gradients(folder: &Folder, group: usize, rows: &Magnets, widths: &Widths) -> Unknown {
    let integrated = |&row: &usize| folder.lattice[row].k1 * folder.lattice[row].length;
    if cut(folder, rows).any(|magnet| magnet.iter().map(integrated).sum::<f64>().abs() > widths.skew) {
        return Unknown { kind: Kind::Strength(group), mean: 1.0, width: widths.strength };
    }
    let length = length(folder, rows) / rows.len() as f64;
    Unknown { kind: Kind::Added(group), mean: 0.0, width: widths.skew / length }
}

/// All unknowns of a measurement, magnets first.
pub fn unknowns(folder: &Folder, groups: &Groups, coupling: bool, widths: &Widths) -> Vec<Unknown> {
    let magnets = groups[0].iter().enumerate().map(|(group, rows)| of_gradients(folder, group, rows, widths));
    let skews = (0..groups[1].len()).map(|group| Unknown { kind: Kind::Skew(group), mean: 0.0, width: widths.skew });
    let monitors = (0..folder.monitors.len()).filter(|&row| folder.monitors[row].is_used);
    let monitors = monitors.flat_map(|row| {
        [
            Unknown { kind: Kind::MonitorGain(row), mean: 1.0, width: widths.gain },
            Unknown { kind: Kind::MonitorCoupling(row), mean: 0.0, width: widths.coupling },
        ]
    });
    let correctors = (0..folder.correctors.len()).filter(|&column| folder.correctors[column].is_used);
    let correctors = correctors.flat_map(|column| {
        [
            Unknown { kind: Kind::CorrectorGain(column), mean: 1.0, width: widths.gain },
            Unknown { kind: Kind::CorrectorCoupling(column), mean: 0.0, width: widths.coupling },
        ]
    });
    let rf = folder.dispersion.is_some().then_some(Unknown { kind: Kind::RfScale, mean: 1.0, width: 0.1 });
    let instruments = monitors.chain(correctors);
    let instruments = instruments
        .filter(|one| coupling || !matches!(one.kind, Kind::MonitorCoupling(_) | Kind::CorrectorCoupling(_)));
    magnets.chain(skews).chain(instruments).chain(rf).collect()
}

/// Gain and coupling of each row or column: 1 and 0 of one that is not fitted.
pub fn gains(
    (unknowns, values): (&[Unknown], &DVector<f64>),
    lines: usize,
    place: fn(Kind) -> Option<(usize, usize)>,
) -> Vec<[f64; 2]> {
    let mut all = vec![[1.0, 0.0]; lines];
    for (unknown, &value) in unknowns.iter().zip(values) {
        if let Some((line, which)) = place(unknown.kind) {
            all[line][which] = value;
        }
    }
    all
}

/// True where a group of magnets has another one, and more.
pub fn holds(group: &Magnets, other: &Magnets) -> bool {
    other.len() < group.len() && group.contains(&other[0])
}

/// Name of magnets that share a factor: of one magnet, of a family, or of what all have in common.
fn strengths(folder: &Folder, groups: &[Magnets], group: &Magnets) -> String {
    let first = &folder.lattice[group[0]];
    let all = |is_alike: &dyn Fn(&Row) -> bool| group.iter().all(|&row| is_alike(&folder.lattice[row]));
    match groups.iter().any(|other| holds(group, other)) {
        false => folder.element(group[0]),
        true if all(&|row| row.name == first.name) => first.name.clone(),
        true if all(&|row| (row.k1 > 0.0) == (first.k1 > 0.0)) => {
            format!("all {} quadrupoles", if first.k1 > 0.0 { "focusing" } else { "defocusing" })
        }
        true => "all quadrupoles".into(),
    }
}

/// Name of an unknown.
pub fn name(folder: &Folder, groups: &Groups, kind: Kind) -> String {
    match kind {
        Kind::Strength(group) => strengths(folder, &groups[0], &groups[0][group]),
        Kind::Added(group) => folder.element(groups[0][group][0]),
        Kind::Skew(group) => folder.element(groups[1][group][0]),
        Kind::Gradient(group) => folder.element(groups[2][group][0]),
        Kind::Wiggler(group) | Kind::Moment(.., group) => folder.element(middle(&groups[3][group])),
        Kind::MonitorGain(row) | Kind::MonitorCoupling(row) => folder.monitor(row),
        Kind::CorrectorGain(column) | Kind::CorrectorCoupling(column) => folder.corrector(column),
        Kind::RfScale | Kind::HeldFrequency => "RF".into(),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::testing::ring;

    #[test]
    fn a_magnet_that_is_cut_into_many_rows_keeps_its_factor() {
        let mut ring = ring();
        ring.meta.reference_fit = None;
        // of 1.2 /m, cut into rows of 0.004 /m with markers between them
        let pieces = |row: &Row| {
            let count = if row.name == "QF" { 300 } else { 1 };
            let piece = Row { length: row.length / f64::from(count), ..row.clone() };
            let marker = Row { name: "M".into(), length: 0.0, k1: 0.0, ..row.clone() };
            (0..count).flat_map(move |_| [piece.clone(), marker.clone()])
        };
        ring.lattice = ring.lattice.iter().flat_map(pieces).collect();
        let all = unknowns(&ring, &groups(&ring), false, &Widths::default());
        let [strengths, added] = [
            all.iter().filter(|one| matches!(one.kind, Kind::Strength(_))).count(),
            all.iter().filter(|one| matches!(one.kind, Kind::Added(_))).count(),
        ];
        assert_eq!([strengths, added], [24, 0]);
    }
}
