//! The families of ordinary imperfections: one property of all instruments or magnets of a sort.

use inference::BaseTerm;
use twin::{EffectKind, Plane, Ring, Site};

use super::close_tunes;
use super::data::Data;
use super::feed_down;
use super::term::Term;
use super::unknown::{Member, Quantity, Unknown, is_absorbed};

/// Which members share an amplitude.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Grouping {
    /// None.
    Each,
    /// Both planes of an instrument.
    Instrument,
    /// All in a plane.
    Plane(Plane),
    /// All.
    All,
    /// None, and each has a width of its own: that of the orbit in sextupole fields ([`super::feed_down`]), which each recording has for itself.
    OfOrbit,
}

/// One property of all instruments or magnets of a sort.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Family {
    /// The property, as the head of a table's row.
    pub name: &'static str,
    /// What is wrong with a member.
    pub kind: EffectKind,
    /// Which members share an amplitude.
    pub grouping: Grouping,
    /// Standard deviation that is ordinary, in the unit of the kind; of one whose members have their own, 1.
    pub tolerance: f64,
    /// Standard deviation of the amplitudes, in the same unit.
    pub width: f64,
}

/// Share of the full width that dipoles which hide something have beside straights that do. Beside one such dipole the NEES per var is 2.1 (`average.rs`); 0.4
/// would lower that, but make it 0.56 instead of 0.7 where nothing is hidden, the common case.
const HIDDEN: f64 = 0.15;
/// Gains scatter by 2 to 5 % (J. Safranek, NIM A 388 (1997) 27); surveys leave 10 mrad to instruments and 1 mrad to quadrupoles;
/// the planes of an instrument that reads or kicks in both are coupled by a per cent, each by itself: half of the sum of both couplings is one of these
/// families, half of the difference a roll; the electronics of all monitors have a common factor; a dipole's poles are parallel to
/// 1 % of its aperture; iron keeps per mille of its field; eddy currents as in [`EffectKind::prior_scale`]. What decks differ by is [`BaseTerm`]'s.
///
/// Those that change the focusing come first: the vars absorb most of them, so that a fit takes them as exactly as the vars. The last is what the orbit adds
/// that nobody knows.
const FAMILIES: [Family; 19] = [
    Family::of_base(BaseTerm::DipoleGradient, Grouping::All),
    Family::of_base(BaseTerm::DipoleEdge, Grouping::All),
    Family::of("sextupole in all dipoles", EffectKind::DipoleSextupole, Grouping::All, 0.1),
    Family::of_base(BaseTerm::Momentum, Grouping::All),
    Family::of("gradients in straights", EffectKind::StrayGradient, Grouping::Each, 5e-4),
    Family::of("gains of monitors", EffectKind::BpmGain, Grouping::Each, 0.02),
    Family::of("gain of all horizontal monitors", EffectKind::BpmGain, Grouping::Plane(Plane::X), 0.03),
    Family::of("gain of all vertical monitors", EffectKind::BpmGain, Grouping::Plane(Plane::Y), 0.03),
    Family::of("gains of correctors", EffectKind::CorrectorGain, Grouping::Each, 0.02),
    Family::of_base(BaseTerm::Kick(Plane::X), Grouping::Plane(Plane::X)),
    Family::of_base(BaseTerm::Kick(Plane::Y), Grouping::Plane(Plane::Y)),
    Family::of_base(BaseTerm::RfStep, Grouping::All),
    Family::of("rolls of monitors", EffectKind::BpmRoll, Grouping::Each, 0.01),
    Family::of("rolls of correctors", EffectKind::CorrectorRoll, Grouping::Each, 0.01),
    Family::of("couplings of monitors", EffectKind::BpmCoupling, Grouping::Instrument, 0.01),
    Family::of("couplings of correctors", EffectKind::CorrectorCoupling, Grouping::Instrument, 0.01),
    Family::of("hysteresis of all correctors", EffectKind::CorrectorHysteresis, Grouping::All, 5e-3),
    Family::of("rolls of quadrupoles", EffectKind::QuadRoll, Grouping::Each, close_tunes::ROLL),
    Family::of("orbit in sextupoles", EffectKind::QuadRoll, Grouping::OfOrbit, 1.0),
];

impl Family {
    /// All of them, and what the orbit adds that nobody knows.
    pub fn all() -> Vec<Self> {
        FAMILIES.to_vec()
    }

    /// Those of magnets and instruments.
    pub fn of_machine() -> Vec<Self> {
        FAMILIES[..FAMILIES.len() - 1].to_vec()
    }

    /// As wide as its tolerance.
    const fn of(name: &'static str, kind: EffectKind, grouping: Grouping, tolerance: f64) -> Self {
        Self { name, kind, grouping, tolerance, width: tolerance }
    }

    /// What all magnets or correctors of a deck have in common.
    const fn of_base(term: BaseTerm, grouping: Grouping) -> Self {
        Self { name: term.name(), kind: term.kind(), grouping, tolerance: term.ordinary(), width: term.width() }
    }

    /// Its members; of a family that each recording has for itself those of each.
    pub fn members(&self, data: &Data) -> Vec<Member> {
        self.members_with_widths(data).into_iter().map(|(member, _)| member).collect()
    }

    /// Its members as unknowns of a fit.
    pub fn unknowns(&self, data: &Data) -> Vec<Unknown> {
        let unknown = |(member, sigma)| Unknown { quantity: Quantity::Ordinary(member), sigma };
        self.members_with_widths(data).into_iter().map(unknown).collect()
    }

    fn members_with_widths(&self, data: &Data) -> Vec<(Member, f64)> {
        let rolls: Vec<Vec<f64>> = match self.grouping {
            Grouping::OfOrbit => data.campaigns().map(|own| feed_down::rolls(&own.ring, &own.baseline)).collect(),
            _ => Vec::new(),
        };
        let campaigns: Vec<Option<usize>> =
            if self.is_of_each() { (0..data.count()).map(Some).collect() } else { vec![None] };
        let mut all = Vec::new();
        for terms in self.terms(data) {
            for &campaign in &campaigns {
                let width = match (campaign, terms[0].site) {
                    (Some(own), Site::Quadrupole(at)) => self.width * rolls[own][at],
                    _ => self.width,
                };
                if width > 0.0 {
                    all.push((Member { family: self.name, terms: terms.clone(), campaign }, width));
                }
            }
        }
        all
    }

    /// True for what each recording has for itself: the momentum and fields of eddy currents, which differ between two times in the cycle, and the orbit.
    fn is_of_each(&self) -> bool {
        self.grouping == Grouping::OfOrbit
            || matches!(self.kind, EffectKind::MomentumOffset | EffectKind::DipoleSextupole)
    }

    /// Its effects, those that share an amplitude together.
    fn terms(&self, data: &Data) -> Vec<Vec<Term>> {
        let all = members(self.kind, data).into_iter();
        let some: Vec<Vec<Term>> = match self.grouping {
            Grouping::Each | Grouping::OfOrbit => {
                return all.filter(|term| whole_of(self.kind) != Some(term.site)).map(|term| vec![term]).collect();
            }
            Grouping::Instrument => {
                let element = |term: &Term| term.site.elements(&data.ring);
                let mut all: Vec<Term> = all.collect();
                all.sort_by_key(element);
                return all.chunk_by(|one, other| element(one) == element(other)).map(<[Term]>::to_vec).collect();
            }
            Grouping::Plane(plane) => vec![all.filter(|term| plane_of(&data.ring, term.site) == Some(plane)).collect()],
            Grouping::All => {
                vec![all.filter(|term| whole_of(self.kind).is_none_or(|site| site == term.site)).collect()]
            }
        };
        some.into_iter().filter(|terms| !terms.is_empty()).collect()
    }

    /// The same with room for what a recording cannot show, since the vars absorb it: as wide as one effect of its kind's prior at any one of the `n`
    /// places that it may have makes it, `scale/sqrt(n)`; not so what many places share.
    pub fn unseen(&self, data: &Data) -> Self {
        let places = members(self.kind, data).len().max(1);
        let is_single = self.grouping == Grouping::Each || places == 1;
        let scale = self.kind.prior_scale().filter(|_| is_absorbed(self.kind) && is_single).unwrap_or(0.0);
        Self { width: self.width.max(scale / (places as f64).sqrt()), ..*self }
    }

    /// What no fit holds, since the vars absorb it, and what widens them all the same: gradients and edge angles of single dipoles, by a share of the
    /// width above.
    pub fn hidden(data: &Data) -> Vec<Self> {
        let hidden_family = |(name, kind)| {
            let unseen = Self { name, kind, grouping: Grouping::Each, tolerance: 0.0, width: 0.0 }.unseen(data);
            Self { width: HIDDEN * unseen.width, ..unseen }
        };
        [("gradients in dipoles", EffectKind::DipoleGradient), ("edge angles of dipoles", EffectKind::DipoleEdge)]
            .map(hidden_family)
            .into()
    }

    /// True if its width is learnt.
    pub fn is_learnt(&self) -> bool {
        matches!(self.grouping, Grouping::Each | Grouping::Instrument) && self.kind != EffectKind::StrayGradient
    }

    /// The instruments or magnets that it holds: `x`, `y`, `H`, `V` or `all`.
    pub fn place(&self) -> &'static str {
        match (self.grouping, self.kind) {
            (Grouping::Plane(Plane::X), EffectKind::CorrectorGain) => "H",
            (Grouping::Plane(Plane::Y), EffectKind::CorrectorGain) => "V",
            (Grouping::Plane(Plane::X), _) => "x",
            (Grouping::Plane(Plane::Y), _) => "y",
            (Grouping::Each | Grouping::Instrument | Grouping::All | Grouping::OfOrbit, _) => "all",
        }
    }

    /// `ln` prior of its width, relative to that of none.
    pub(crate) fn log_prior(&self) -> f64 {
        if self.is_learnt() { -0.5 * (self.width / self.tolerance).powi(2) } else { 0.0 }
    }
}

/// The site that stands for the whole ring, of a kind that has one beside single places.
fn whole_of(kind: EffectKind) -> Option<Site> {
    (kind == EffectKind::DipoleEdge).then_some(Site::Ring)
}

fn plane_of(ring: &Ring, site: Site) -> Option<Plane> {
    match site {
        Site::Monitor(at) => Some(ring.monitors[at].plane),
        Site::Corrector(at) => Some(ring.correctors[at].plane),
        _ => None,
    }
}

/// The kind of the family that an effect of an instrument is a member of: a dead instrument has a gain error of -1, a reversed one of -2.
pub fn family_of(kind: EffectKind) -> EffectKind {
    match kind {
        EffectKind::BpmDead | EffectKind::BpmPolarity => EffectKind::BpmGain,
        EffectKind::CorrectorDead | EffectKind::CorrectorPolarity => EffectKind::CorrectorGain,
        other => other,
    }
}

/// The members of a family that affect the data, those of any recording.
pub fn members(kind: EffectKind, data: &Data) -> Vec<Term> {
    let driven: Vec<usize> = data.campaigns().flat_map(Data::driven_correctors).collect();
    let active = data.campaigns().flat_map(Data::active_monitors);
    let active: Vec<usize> = active.map(|b| data.ring.read_monitors[b]).collect();
    let tells = |site: &Site| match site {
        Site::Monitor(at) => active.contains(at),
        Site::MonitorPair(one, other) => active.contains(one) && active.contains(other),
        Site::Corrector(at) => driven.contains(at),
        Site::CorrectorPair(one, other) => driven.contains(one) && driven.contains(other),
        Site::Ring | Site::Quadrupole(_) | Site::Element(_) => true,
    };
    kind.sites(&data.ring).into_iter().filter(tells).map(|site| Term { kind, site }).collect()
}
