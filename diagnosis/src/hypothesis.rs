//! A hypothesis about a machine: some effects, and the unknowns that they add to the vars.

use core::cmp::Reverse;

use twin::{Drives, Effect, EffectError, EffectKind, Machine, Ring, Site};

use super::data::Data;
use super::element::Element;
use super::family::Family;
use super::scatter::Scatter;
use super::term::Term;
use super::units::Units;
use super::unknown::{Quantity, Unknown};

/// Some effects, any number of them.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Hypothesis {
    /// Effects that count as findings.
    pub terms: Vec<Term>,
    /// Those of them that are gross, whose amplitudes have a wider prior.
    pub gross: Vec<Term>,
    /// Something that the library does not hold.
    pub element: Option<Element>,
    /// Ordinary imperfections.
    pub ordinary: Vec<Family>,
    /// Scatter of the vars.
    pub scatter: Scatter,
    /// Effects of known amplitude.
    pub given: Vec<Effect>,
}

/// Prior probability that an effect of an instrument is gross, an attenuator of 6 dB that was left in, half of a coil that is shorted, and the width of its
/// prior over that of others: a gain is then off by 40 %.
const GROSS: f64 = 0.1;
const WIDER: f64 = 5.0;

impl Hypothesis {
    /// No effect, and everything ordinary.
    pub fn plain() -> Self {
        Self { ordinary: Family::all(), ..Self::default() }
    }

    /// The same with room for what a recording cannot show.
    pub fn unseen(&self, data: &Data) -> Self {
        Self { ordinary: self.ordinary.iter().map(|family| family.unseen(data)).collect(), ..self.clone() }
    }

    /// One more effect.
    pub fn with(&self, term: Term) -> Self {
        let mut more = self.clone();
        more.terms.push(term);
        more
    }

    /// The same with one of its effects gross; none for a field, which iron and alignment bound.
    pub(crate) fn with_gross(&self, index: usize) -> Option<Self> {
        let term = self.terms[index];
        let kind = term.kind;
        let is_of_an_instrument = kind.is_of_a_monitor() || kind.is_of_a_corrector() || kind == EffectKind::RfStep;
        is_of_an_instrument.then(|| {
            let mut gross = self.clone();
            gross.gross.push(term);
            gross
        })
    }

    /// Without one.
    pub fn without(&self, index: usize) -> Self {
        let term = self.terms[index];
        self.without_terms(|one| *one == term)
    }

    /// `ln` prior of the widths that its unknowns have: of vars relative to that of their prior, of ordinary families to none, of gross effects to usual
    /// ones.
    pub(crate) fn log_prior(&self) -> f64 {
        let of_families: f64 = self.ordinary.iter().map(Family::log_prior).sum();
        self.scatter.log_prior() + of_families + self.gross.len() as f64 * GROSS.ln()
    }

    /// The vars in units of their scatter.
    pub fn units(&self, data: &Data) -> Units {
        data.units.scaled(self.scatter.0)
    }

    /// Prior standard deviation of a term's amplitude; none for a switch.
    fn scale(&self, term: &Term) -> Option<f64> {
        term.kind.prior_scale().map(|scale| scale * if self.gross.contains(term) { WIDER } else { 1.0 })
    }

    /// The unknowns besides the vars.
    pub fn unknowns(&self, data: &Data) -> Vec<Unknown> {
        let of_term = |term: &Term| {
            let quantity = Quantity::Amplitude(*term);
            let amplitude = self.scale(term).map(|sigma| Unknown { quantity, sigma });
            let seen = term.kind.orbit(&data.ring, term.site);
            let orbit = data.campaigns().enumerate().flat_map(|(campaign, own)| {
                seen.iter().map(move |&(element, plane)| Unknown {
                    quantity: Quantity::Orbit(campaign, element, plane),
                    sigma: own.baseline.sigma[element][plane.index()],
                })
            });
            amplitude.into_iter().chain(orbit).collect::<Vec<_>>()
        };
        let terms = self.terms.iter().flat_map(of_term);
        let of_element = |element: &Element| {
            let quadrupole = element.quadrupole;
            let forms = element.forms.clone().into_iter();
            forms.map(move |(form, sigma)| Unknown { quantity: Quantity::Form(quadrupole, form), sigma })
        };
        let forms = self.element.iter().flat_map(of_element);
        terms.chain(forms).chain(self.ordinary.iter().flat_map(|family| family.unknowns(data))).collect()
    }

    /// Without some.
    pub fn without_terms(&self, is_one: impl Fn(&Term) -> bool) -> Self {
        let mut less = self.clone();
        less.terms.retain(|term| !is_one(term));
        less.gross.retain(|term| !is_one(term));
        less
    }

    /// Without a family whose only member is this effect: it predicts as the effect does, at another size.
    pub(crate) fn without_family(&self, term: Term, data: &Data) -> Self {
        let is_it = |family: &Family| {
            let members = family.members(data);
            !members.is_empty() && members.iter().all(|member| member.terms == [term])
        };
        let mut less = self.clone();
        less.ordinary.retain(|family| !is_it(family));
        less
    }

    /// Without the unknown element.
    pub fn without_element(&self) -> Self {
        Self { element: None, ..self.clone() }
    }

    /// Number of its effects, the unknown element as one.
    pub fn count(&self) -> usize {
        self.terms.len() + usize::from(self.element.is_some())
    }

    /// True if one more effect would be what it has already.
    pub fn holds(&self, term: &Term, ring: &Ring) -> bool {
        self.terms.contains(term) || self.element.as_ref().is_some_and(|element| element.holds(term, ring))
    }

    /// The machine in one of the recordings and its drives, at given `ln` vars and values of the unknowns in units of their standard deviations, without the
    /// unknown element.
    ///
    /// # Errors
    /// [`EffectError`] if an effect is not defined at its place.
    pub fn machine(
        &self,
        data: &Data,
        campaign: usize,
        params: &[f64],
        unknown: &[f64],
    ) -> Result<(Machine, Drives), EffectError> {
        let recording = data.campaign(campaign);
        let scaled = |term: &Term, amplitude: f64| term.effect(amplitude * data.scale(campaign, term.kind));
        let mut effects: Vec<Effect> = self.terms.iter().map(|term| term.effect(1.0)).collect();
        effects.extend(&self.given);
        let mut ordinary = Vec::new();
        let mut drives = recording.drives.clone();
        for (Unknown { quantity, sigma }, u) in self.unknowns(data).iter().zip(unknown) {
            match quantity {
                Quantity::Amplitude(term) => {
                    let at = self.terms.iter().position(|one| one == term).expect("it is of one of the terms");
                    effects[at] = scaled(term, u * sigma);
                }
                Quantity::Orbit(of, element, plane) if *of == campaign => {
                    drives.orbit[*element][plane.index()] += u * sigma;
                }
                Quantity::Ordinary(member) if member.is_in(campaign) => {
                    ordinary.extend(member.terms.iter().map(|term| scaled(term, u * sigma)));
                }
                Quantity::Orbit(..) | Quantity::Form(..) | Quantity::Ordinary(_) => {}
            }
        }
        let effects = in_order(effects, ordinary);
        effects.iter().for_each(|effect| correct_orbit(recording, &mut drives, effect));
        let ring = recording.ring.with_strengths(&recording.ring.strengths(params, &recording.supplies));
        Ok((Machine::new(ring, recording.believed, &effects)?, drives))
    }
}

/// Effects beside ordinary imperfections, in the order in which a signal passes them: correctors, ordinary imperfections, fields, monitors.
///
/// Of correctors and monitors what has an amplitude is next to the beam, then what is reversed or dead, then what is exchanged: the current of a dead corrector
/// is none before its coils couple, and exchanged names are given to what monitors read. Of the same sort the later one is nearer. An effect is scored as if
/// it were next to the beam, so that a fit with one more has what was scored, to first order in what is ordinary; but for an exchange of instruments of
/// which one is known to be reversed or dead.
pub fn in_order(effects: Vec<Effect>, ordinary: impl IntoIterator<Item = Effect>) -> Vec<Effect> {
    let from_beam = |effect: &Effect| match effect.kind.is_switch() {
        false => 0,
        true if effect.site.is_pair() => 2,
        true => 1,
    };
    let (mut of_correctors, others): (Vec<Effect>, Vec<Effect>) =
        effects.into_iter().partition(|effect| effect.kind.is_of_a_corrector());
    let (mut of_monitors, of_the_ring): (Vec<Effect>, Vec<Effect>) =
        others.into_iter().partition(|effect| effect.kind.is_of_a_monitor());
    of_correctors.sort_by_key(|effect| Reverse(from_beam(effect)));
    of_monitors.reverse();
    of_monitors.sort_by_key(from_beam);
    of_correctors.into_iter().chain(ordinary).chain(of_the_ring).chain(of_monitors).collect()
}

/// The orbit at a monitor was estimated as if it read what is there: not so where it misreads large positions.
fn correct_orbit(data: &Data, drives: &mut Drives, effect: &Effect) {
    let Site::Monitor(at) = effect.site else { return };
    let Some(b) = data.ring.read_monitors.iter().position(|&read| read == at) else { return };
    for (element, plane) in effect.kind.orbit(&data.ring, effect.site) {
        let orbit = &mut drives.orbit[element][plane.index()];
        *orbit = data.baseline.corrected(b, *orbit, |x| effect.misreads(x));
    }
}
