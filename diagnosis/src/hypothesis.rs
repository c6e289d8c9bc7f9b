//! What may be true of a machine: some effects, and what is then unknown beside the vars.

use serde::Serialize;
use twin::{Drives, Effect, EffectError, EffectKind, Machine, Plane, Rf};

use super::data::Data;

/// One effect that a hypothesis holds, its amplitude unknown.
#[derive(Debug, Clone, PartialEq, Eq, Hash, Serialize)]
pub struct Term {
    /// What happens.
    #[serde(serialize_with = "word")]
    pub kind: EffectKind,
    /// Where.
    pub place: String,
}

fn word<S: serde::Serializer>(kind: &EffectKind, serializer: S) -> Result<S::Ok, S::Error> {
    serializer.serialize_str(kind.word())
}

/// Instruments or magnets that all scatter a little: ordinary, and no discovery.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Scatter {
    /// What of them scatters.
    #[serde(serialize_with = "word")]
    pub kind: EffectKind,
    /// Standard deviation, in the unit of the kind.
    pub width: f64,
}

/// Some effects, any number of them.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Hypothesis {
    /// Discoveries.
    pub terms: Vec<Term>,
    /// Ordinary scatter.
    pub scatter: Vec<Scatter>,
    /// Effects of known amplitude.
    pub given: Vec<Effect>,
}

/// One number that is unknown beside the vars, with its prior standard deviation.
#[derive(Debug, Clone, PartialEq)]
pub enum Unknown {
    /// The amplitude of a term.
    Amplitude(usize, f64),
    /// The orbit at the element of a term, in x or y [m].
    Orbit(usize, Plane, f64),
    /// One member of a scatter.
    Member(Term, f64),
}

impl Term {
    /// An effect at a place.
    pub fn new(kind: EffectKind, place: &str) -> Self {
        Self { kind, place: place.into() }
    }

    /// `kind@place`.
    pub fn label(&self) -> String {
        if self.place.is_empty() { self.kind.word().into() } else { format!("{}@{}", self.kind.word(), self.place) }
    }

    /// Where it sits along the beam [m], if it is at one place.
    pub fn position(&self, data: &Data) -> Option<f64> {
        self.element(data).map(|at| data.ring.elements[at].s + 0.5 * data.ring.elements[at].length)
    }

    /// The element it sits at.
    pub fn element(&self, data: &Data) -> Option<usize> {
        let ring = &data.ring;
        let first = self.place.split(',').next().filter(|place| !place.is_empty())?;
        let (prefix, cell) = first.split_once('_').unwrap_or(("", first));
        match prefix {
            "x" => ring.monitor(Plane::X, cell).ok().map(|m| ring.monitors[m].element),
            "y" => ring.monitor(Plane::Y, cell).ok().map(|m| ring.monitors[m].element),
            "H" => ring.corrector(Plane::X, cell).ok().map(|c| ring.correctors[c].element),
            "V" => ring.corrector(Plane::Y, cell).ok().map(|c| ring.correctors[c].element),
            "SX" => {
                ring.elements.iter().position(|e| matches!(e.kind, twin::Kind::Sextupole { .. }) && e.label == cell)
            }
            "" => ring.quadrupole(cell).ok().map(|q| ring.quadrupoles[q].element),
            _ => ring.element(first).ok(),
        }
    }

    /// What a monitor with this plane of the orbit sees, for a term whose size depends on the orbit.
    fn orbits(&self) -> &'static [Plane] {
        match self.kind {
            EffectKind::BpmCubic if self.place.starts_with("y_") => &[Plane::Y],
            EffectKind::BpmCubic => &[Plane::X],
            EffectKind::SextupoleError => &[Plane::X, Plane::Y],
            _ => &[],
        }
    }
}

impl Hypothesis {
    /// One more effect.
    pub fn with(&self, term: Term) -> Self {
        let mut more = self.clone();
        more.terms.push(term);
        more
    }

    /// Without one.
    pub fn without(&self, index: usize) -> Self {
        let mut less = self.clone();
        less.terms.remove(index);
        less
    }

    /// What is unknown beside the vars.
    pub fn unknowns(&self, data: &Data) -> Vec<Unknown> {
        let of_term = |(i, term): (usize, &Term)| {
            let amplitude = term.kind.prior_scale().map(|scale| Unknown::Amplitude(i, scale));
            let orbit = term.orbits().iter().filter_map(move |&plane| {
                let sigma = data.baseline.sigma[term.element(data)?][usize::from(plane == Plane::Y)];
                Some(Unknown::Orbit(i, plane, sigma))
            });
            amplitude.into_iter().chain(orbit.collect::<Vec<_>>()).collect::<Vec<_>>()
        };
        let of_scatter = |scatter: &Scatter| {
            let Scatter { kind, width } = *scatter;
            members(kind, data).into_iter().map(move |term| Unknown::Member(term, width)).collect::<Vec<_>>()
        };
        let terms = self.terms.iter().enumerate().flat_map(of_term);
        terms.chain(self.scatter.iter().flat_map(of_scatter)).collect()
    }

    /// Number of unknowns that are members of a scatter; they stand last.
    pub fn members(&self, data: &Data) -> usize {
        self.scatter.iter().map(|scatter| members(scatter.kind, data).len()).sum()
    }

    /// The machine, and what drives it, at given `ln` vars and values of the unknowns in units of their standard deviations.
    ///
    /// # Errors
    /// [`EffectError`] if a place is none.
    pub fn machine(&self, data: &Data, params: &[f64], unknown: &[f64]) -> Result<(Machine, Drives), EffectError> {
        let strength: Vec<f64> =
            params.iter().zip(&data.supplies).map(|(theta, supply)| (theta + supply).exp()).collect();
        let mut effects: Vec<Effect> =
            self.terms.iter().map(|t| Effect { kind: t.kind, place: t.place.clone(), amplitude: 1.0 }).collect();
        effects.extend(self.given.iter().chain(&data.believed).cloned());
        let mut drives = data.drives.clone();
        for (what, u) in self.unknowns(data).iter().zip(unknown) {
            match what {
                Unknown::Amplitude(i, sigma) => effects[*i].amplitude = u * sigma,
                Unknown::Orbit(i, plane, sigma) => {
                    if let Some(at) = self.terms[*i].element(data) {
                        drives.orbit[at][usize::from(*plane == Plane::Y)] += u * sigma;
                    }
                }
                Unknown::Member(term, sigma) => {
                    effects.push(Effect { kind: term.kind, place: term.place.clone(), amplitude: u * sigma });
                }
            }
        }
        Ok((Machine::new(data.ring.with_vars(&strength), Rf::FixedMomentum, &effects)?, drives))
    }

    /// `kind@place + kind@place`, or `nothing`.
    pub fn label(&self) -> String {
        let terms: Vec<String> = self.terms.iter().map(Term::label).collect();
        if terms.is_empty() { "nothing".into() } else { terms.join(" + ") }
    }
}

/// The members of a family that the data can say anything about.
pub fn members(kind: EffectKind, data: &Data) -> Vec<Term> {
    let driven = data.driven_correctors();
    let speaking = data.speaking_monitors();
    let sites = kind.sites(&data.ring);
    let of = |indices: &[usize]| indices.iter().map(|&i| Term::new(kind, &sites[i])).collect();
    match kind {
        EffectKind::BpmGain | EffectKind::BpmRoll | EffectKind::BpmCubic => of(&speaking),
        EffectKind::CorrectorGain
        | EffectKind::CorrectorRoll
        | EffectKind::CorrectorPolarity
        | EffectKind::CorrectorEven => of(&driven),
        EffectKind::BpmSwap => {
            let names = data.ring.monitor_names();
            let silent = |name: &str| !speaking.iter().any(|&b| names[b] == name);
            sites.iter().filter(|pair| !pair.split(',').any(silent)).map(|pair| Term::new(kind, pair)).collect()
        }
        _ => sites.iter().map(|site| Term::new(kind, site)).collect(),
    }
}
