//! The machine file: its JSON, checked and turned into a ring.

use std::collections::{BTreeMap, BTreeSet};
use std::path::Path;

use serde::Deserialize;

use super::family::{Circuits, Families, Listed};
use super::label::{Named, labels};
use super::{
    Bend, Corrector, Currents, Element, Kind, LatticeError, Misalignment, Monitor, ParameterPrior, Particle, Plane,
    Ring, ramp,
};
use crate::limits;

#[derive(Deserialize)]
struct MachineFile {
    name: String,
    circumference_m: f64,
    k1: BTreeMap<String, f64>,
    #[serde(default)]
    currents: Option<Currents>,
    reference: Reference,
    #[serde(default)]
    data: Data,
    #[serde(default)]
    families: Families,
    #[serde(default)]
    ramp: Vec<ramp::Listed>,
    elements: Vec<Entry>,
}

#[derive(Deserialize)]
struct Reference {
    particle: String,
    #[serde(rename = "kinetic_energy_GeV")]
    kinetic_energy: f64,
}

/// Relative difference of a strength that is stated from that of the supply law, up to which it is rounding of the file's numbers.
const SAME: f64 = 1e-6;

/// What is read and fitted; further keys of `data` are for people.
#[derive(Deserialize, Default)]
struct Data {
    bpm_x: Option<Vec<String>>,
    bpm_y: Option<Vec<String>>,
    prior_width: Option<f64>,
    range: Option<[f64; 2]>,
}

/// The planes that a monitor reads or a corrector kicks in.
#[derive(Deserialize, Clone, Copy, PartialEq)]
enum Planes {
    H,
    V,
    HV,
}

impl Planes {
    fn list(self) -> &'static [Plane] {
        match self {
            Self::H => &[Plane::X],
            Self::V => &[Plane::Y],
            Self::HV => &[Plane::X, Plane::Y],
        }
    }
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Entry {
    name: String,
    #[serde(rename = "type")]
    kind: String,
    s_start: f64,
    length: f64,
    label: Option<String>,
    sector: Option<String>,
    plane: Option<Planes>,
    family: Option<String>,
    fit: Option<bool>,
    k1: Option<f64>,
    k2: Option<f64>,
    k1l: Option<f64>,
    k1sl: Option<f64>,
    focusing: Option<f64>,
    k2l: Option<f64>,
    k3l: Option<f64>,
    ks: Option<f64>,
    angle: Option<f64>,
    e1: Option<f64>,
    e2: Option<f64>,
    hgap: Option<f64>,
    fint: Option<f64>,
    dx: Option<f64>,
    dy: Option<f64>,
    roll: Option<f64>,
    #[serde(rename = "note")]
    _note: Option<String>,
    #[serde(rename = "valid_in_paper")]
    _valid_in_paper: Option<bool>,
}

/// Largest gap or overlap between neighbours that counts as rounding of the file's numbers [m].
const ROUNDING: f64 = 1e-6;

/// Built-in machines: names and texts of their files. The first is taken where none is named.
pub const BUILT_IN: [(&str, &str); 2] = [
    ("booster-deck.json", include_str!("../../../machines/booster-deck.json")),
    ("booster.json", include_str!("../../../machines/booster.json")),
];

impl Ring {
    /// The AGS Booster of its laboratory's deck, `machines/booster-deck.json`.
    pub fn booster() -> Self {
        Self::of_built_in(BUILT_IN[0])
    }

    /// The AGS Booster as its published inference describes it, `machines/booster.json`: dipoles without a gradient, and fewer currents.
    pub fn paper_booster() -> Self {
        Self::of_built_in(BUILT_IN[1])
    }

    /// A built-in machine by the name of its file, as headers of recordings state it.
    pub fn built_in(file: &str) -> Option<Self> {
        BUILT_IN.into_iter().find(|(name, _)| *name == file).map(Self::of_built_in)
    }

    fn of_built_in((file, text): (&str, &str)) -> Self {
        Self::parse(text, file).expect("the built-in machine files are tested")
    }

    /// Read a machine file.
    ///
    /// # Errors
    /// [`LatticeError`], naming the element and the numbers that disagree.
    pub fn read(path: &Path) -> Result<Self, LatticeError> {
        let shown = path.display().to_string();
        let text = limits::FILE.text(path).map_err(|source| LatticeError::Read { path: shown.clone(), source })?;
        Self::parse(&text, &shown)
    }

    /// Read the text of a machine file; `path` appears in errors.
    ///
    /// # Errors
    /// As [`Ring::read`].
    pub fn parse(text: &str, path: &str) -> Result<Self, LatticeError> {
        let file: MachineFile =
            limits::json(text).map_err(|source| LatticeError::Syntax { path: path.into(), source })?;
        let name = Path::new(path).file_name().unwrap_or_default().to_string_lossy().into_owned();
        file.ring(name)
    }
}

impl MachineFile {
    fn ring(mut self, file: String) -> Result<Ring, LatticeError> {
        let particle = self.particle()?;
        self.power(&particle)?;
        let (elements, at) = self.line()?;
        let listed = self.quadrupoles(&elements, &at);
        let prior = ParameterPrior::default().or("data", self.data.prior_width, self.data.range)?;
        let circuits = Circuits::of(&listed, &self.families, prior)?;
        let mut ring = Ring {
            monitors: self.instruments("bpm", &at, |element, plane| Monitor { element, plane }),
            correctors: self.instruments("corrector", &at, |element, plane| Corrector { element, plane }),
            read_monitors: Vec::new(),
            quadrupoles: circuits.quadrupoles,
            supplies: circuits.supplies,
            parameters: circuits.parameters,
            circumference: self.circumference_m,
            name: self.name,
            file,
            elements,
            particle,
            ramp: Vec::new(),
            currents: self.currents,
        };
        ring.set_ramp(self.ramp)?;
        for (plane, list) in [(Plane::X, &self.data.bpm_x), (Plane::Y, &self.data.bpm_y)] {
            read_monitors(&mut ring, plane, list.as_deref())?;
        }
        Ok(ring)
    }

    /// Give magnets that state no strength that of the supply law; what is stated has to be the law's.
    fn power(&mut self, particle: &Particle) -> Result<(), LatticeError> {
        let Some(currents) = &self.currents else { return Ok(()) };
        let refused = |name: &str, field, found| Err(LatticeError::Field { name: name.into(), field, found });
        if let Some((field, found)) = currents.lack() {
            return refused("currents", field, found);
        }
        if !self.ramp.is_empty() {
            return refused("currents", "no ramp beside them", format!("one of {} times", self.ramp.len()));
        }
        same("reference", "the momentum of currents [GeV/c]", Some(particle.momentum()), currents.momentum())?;
        let [body_k1, body_k2] = currents.body();
        let mut unused: BTreeSet<&str> = currents.names().collect();
        for entry in &mut self.elements {
            unused.remove(entry.name.as_str());
            let (name, length) = (entry.name.as_str(), entry.length);
            let family = entry.family.as_deref().unwrap_or_default();
            let stated = entry.k1.or_else(|| self.k1.get(family).copied().filter(|_| entry.kind == "quadrupole"));
            match entry.kind.as_str() {
                "quadrupole" => {
                    let supply = self.families.get(family).map_or(Some(family), |of| of.supply(family));
                    supply.iter().for_each(|supply| _ = unused.remove(supply));
                    let k1 = supply.and_then(|supply| currents.k1(supply, name, length));
                    k1.map_or(Ok(()), |k1| same(name, "the k1 of currents", stated, k1))?;
                    entry.k1 = k1.or(entry.k1);
                }
                "sbend" => {
                    body_k1.map_or(Ok(()), |k1| same(name, "the k1 of currents", stated, k1))?;
                    body_k2.map_or(Ok(()), |k2| same(name, "the k2 of currents", entry.k2, k2))?;
                    (entry.k1, entry.k2) = (body_k1.or(entry.k1), body_k2.or(entry.k2));
                }
                "sextupole" => {
                    unused.remove(family);
                    let k2 = currents.k2(family, name, length);
                    k2.map_or(Ok(()), |k2| same(name, "the k2 of currents", entry.k2, k2))?;
                    entry.k2 = k2.or(entry.k2);
                }
                _ => {}
            }
        }
        let unused = unused.first().map(|name| refused("currents", "a magnet for each name in them", (*name).into()));
        unused.unwrap_or(Ok(()))
    }

    fn particle(&self) -> Result<Particle, LatticeError> {
        let refused = |field, found| LatticeError::Field { name: self.name.clone(), field, found };
        let (name, kinetic_energy) = (&self.reference.particle, self.reference.kinetic_energy);
        let rest_energy = Particle::rest_energy_of(name)
            .ok_or_else(|| refused("reference.particle proton or electron", name.clone()))?;
        if kinetic_energy <= 0.0 {
            return Err(refused("a reference.kinetic_energy_GeV above 0", kinetic_energy.to_string()));
        }
        Ok(Particle { rest_energy, kinetic_energy })
    }

    /// The elements in beam order with drifts in the gaps, and where each of the file's stands among them.
    fn line(&self) -> Result<(Vec<Element>, Vec<usize>), LatticeError> {
        if self.circumference_m <= 0.0 {
            let (field, found) = ("a circumference_m above 0", self.circumference_m.to_string());
            return Err(LatticeError::Field { name: self.name.clone(), field, found });
        }
        let named = self.elements.iter().map(Entry::named).collect::<Result<Vec<_>, _>>()?;
        let (mut elements, mut at) = (Vec::new(), Vec::new());
        let mut names = std::collections::HashSet::new();
        for (entry, label) in self.elements.iter().zip(labels(&named)?) {
            let element = entry.element(label, &self.k1)?;
            if !names.insert(&entry.name) {
                return Err(LatticeError::Duplicate { name: element.name, s: element.s });
            }
            append(&mut elements, element)?;
            at.push(elements.len() - 1);
        }
        close(&mut elements, self.circumference_m)?;
        Ok((elements, at))
    }

    fn quadrupoles<'f>(&'f self, elements: &'f [Element], at: &[usize]) -> Vec<Listed<'f>> {
        let listed = |(entry, &element): (&'f Entry, &usize)| match elements[element].kind {
            Kind::Quadrupole { k1 } => Some(Listed {
                element,
                name: &entry.name,
                label: &elements[element].label,
                focusing: k1 > 0.0,
                family: entry.family.as_deref(),
                fit: entry.fit.unwrap_or(true),
            }),
            _ => None,
        };
        self.elements.iter().zip(at).filter_map(listed).collect()
    }

    /// Monitors or correctors, the horizontal ones in beam order, then the vertical ones.
    fn instruments<T>(&self, kind: &str, at: &[usize], make: impl Fn(usize, Plane) -> T) -> Vec<T> {
        let all = || self.elements.iter().zip(at).filter(|(entry, _)| entry.kind == kind);
        let of = |plane: Plane| {
            all().filter(move |(entry, _)| entry.planes().contains(&plane)).map(move |(_, &element)| (element, plane))
        };
        of(Plane::X).chain(of(Plane::Y)).map(|(element, plane)| make(element, plane)).collect()
    }
}

/// Refuses what is stated if it is not what the supply law makes.
fn same(name: &str, field: &'static str, stated: Option<f64>, law: f64) -> Result<(), LatticeError> {
    match stated.filter(|stated| (stated - law).abs() > SAME * law.abs()) {
        Some(stated) => {
            let found = format!("{stated} stated and {law} by the law");
            Err(LatticeError::Field { name: name.into(), field, found })
        }
        None => Ok(()),
    }
}

/// Add the monitors of a plane that are read: those of the list, or all.
fn read_monitors(ring: &mut Ring, plane: Plane, list: Option<&[String]>) -> Result<(), LatticeError> {
    let Some(list) = list else {
        let all = (0..ring.monitors.len()).filter(|&m| ring.monitors[m].plane == plane);
        ring.read_monitors.extend(all);
        return Ok(());
    };
    for name in list {
        let monitor = ring.monitor(plane, name)?;
        if ring.read_monitors.contains(&monitor) {
            let list = if plane == Plane::X { "data.bpm_x" } else { "data.bpm_y" };
            let (name, found) = (list.into(), format!("{name} again"));
            return Err(LatticeError::Field { name, field: "every monitor once", found });
        }
        ring.read_monitors.push(monitor);
    }
    Ok(())
}

impl Entry {
    fn planes(&self) -> &'static [Plane] {
        self.plane.map_or(&[], Planes::list)
    }

    /// As far as its label is concerned.
    fn named(&self) -> Result<Named<'_>, LatticeError> {
        let (name, stated) = (self.name.as_str(), self.label.as_deref());
        let refused = |name: String, field| Err(LatticeError::Field { name, field, found: "an empty one".into() });
        if name.is_empty() {
            return refused(format!("the {} at {} m", self.kind, self.s_start), "a name");
        }
        if stated.is_some_and(str::is_empty) {
            return refused(self.name.clone(), "a label");
        }
        let sorts = match self.kind.as_str() {
            kind @ ("bpm" | "corrector") => self.planes().iter().map(|&plane| (kind, Some(plane))).collect(),
            kind => vec![(kind, None)],
        };
        Ok(Named { name, stated, sorts })
    }

    fn element(&self, label: String, families: &BTreeMap<String, f64>) -> Result<Element, LatticeError> {
        let length = self.finite("a finite length", Some(self.length))?;
        self.check_length(length)?;
        let or_zero = |field, value: Option<f64>| self.finite(field, Some(value.unwrap_or(0.0)));
        Ok(Element {
            name: self.name.clone(),
            label,
            sector: self.sector.clone(),
            kind: self.kind(length, families)?,
            s: self.finite("a finite s_start", Some(self.s_start))?,
            length,
            misalignment: Misalignment {
                dx: or_zero("a finite dx", self.dx)?,
                dy: or_zero("a finite dy", self.dy)?,
                roll: or_zero("a finite roll", self.roll)?,
            },
        })
    }

    fn kind(&self, length: f64, families: &BTreeMap<String, f64>) -> Result<Kind, LatticeError> {
        let family = self.family.as_ref().and_then(|f| families.get(f)).copied();
        let or_zero = |field, value: Option<f64>| self.finite(field, Some(value.unwrap_or(0.0)));
        Ok(match self.kind.as_str() {
            "marker" => Kind::Marker,
            "bpm" => self.has_plane(Kind::Monitor)?,
            "corrector" => self.has_plane(Kind::Corrector { kick: [0.0; 2] })?,
            "quadrupole" => {
                Kind::Quadrupole { k1: self.finite("a finite k1, or a family in the file's k1", self.k1.or(family))? }
            }
            "sextupole" => Kind::Sextupole { k2: or_zero("a finite k2", self.k2)? },
            "multipole" => Kind::Multipole {
                k1l: or_zero("a finite k1l", self.k1l)?,
                k1sl: or_zero("a finite k1sl", self.k1sl)?,
                k2l: or_zero("a finite k2l", self.k2l)?,
                k3l: or_zero("a finite k3l", self.k3l)?,
            },
            "wiggler" => Kind::Wiggler { focusing: or_zero("a finite focusing", self.focusing)? },
            "solenoid" => Kind::Solenoid { ks: self.finite("a finite ks", self.ks)? },
            "sbend" => Kind::Bend(Bend {
                curvature: self.finite("a finite angle", self.angle)? / length,
                k1: or_zero("a finite k1", self.k1)?,
                k2: or_zero("a finite k2", self.k2)?,
                e1: or_zero("a finite e1", self.e1)?,
                e2: or_zero("a finite e2", self.e2)?,
                fringe: 2.0 * or_zero("a finite fint", self.fint)? * or_zero("a finite hgap", self.hgap)?,
            }),
            found => return Err(LatticeError::Type { name: self.name.clone(), found: found.into() }),
        })
    }

    fn finite(&self, field: &'static str, value: Option<f64>) -> Result<f64, LatticeError> {
        value.filter(|v| v.is_finite()).ok_or_else(|| LatticeError::Field {
            name: self.name.clone(),
            field,
            found: value.map_or("nothing".into(), |v| v.to_string()),
        })
    }

    fn check_length(&self, length: f64) -> Result<(), LatticeError> {
        let expected = match self.kind.as_str() {
            "sbend" | "quadrupole" | "solenoid" if length <= 0.0 => "a length above 0",
            "multipole" if length != 0.0 => "a thin element",
            _ if length < 0.0 => "a length of 0 or more",
            _ => return Ok(()),
        };
        Err(LatticeError::Length { name: self.name.clone(), expected, found: length })
    }

    fn has_plane(&self, kind: Kind) -> Result<Kind, LatticeError> {
        let missing =
            || LatticeError::Field { name: self.name.clone(), field: "a plane H, V or HV", found: "nothing".into() };
        self.plane.map(|_| kind).ok_or_else(missing)
    }
}

/// Append an element, with a drift in front of it if there is a gap.
fn append(elements: &mut Vec<Element>, element: Element) -> Result<(), LatticeError> {
    let (end, before) = elements.last().map_or((0.0, "the start".into()), |e| (e.s + e.length, e.name.clone()));
    let gap = element.s - end;
    if gap < -ROUNDING {
        return Err(LatticeError::Overlap { name: element.name, start: element.s, before, end });
    }
    fill(elements, end, gap);
    elements.push(element);
    Ok(())
}

/// Fill the ring up to its circumference.
fn close(elements: &mut Vec<Element>, circumference: f64) -> Result<(), LatticeError> {
    let end = elements.last().map_or(0.0, |e| e.s + e.length);
    if end > circumference + ROUNDING {
        return Err(LatticeError::TooLong { end, circumference });
    }
    fill(elements, end, circumference - end);
    Ok(())
}

fn fill(elements: &mut Vec<Element>, s: f64, length: f64) {
    if length > ROUNDING * 1e-3 {
        elements.push(Element::drift(s, length));
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn machine(elements: &str) -> String {
        format!(
            r#"{{"name":"toy","circumference_m":3.0,"k1":{{}},"reference":{{"particle":"proton","kinetic_energy_GeV":1.0}},
               "data":{{"bpm_x":[],"bpm_y":[]}},"elements":[{elements}]}}"#
        )
    }

    #[test]
    fn a_mistyped_key_is_refused() {
        let text = machine(r#"{"name":"B","type":"sbend","s_start":0,"length":1,"angle":0.1,"E1":0.1}"#);
        assert!(Ring::parse(&text, "toy.json").unwrap_err().to_string().starts_with("toy.json: unknown field `E1`"));
    }

    #[test]
    fn gaps_become_drifts() {
        let ring = Ring::parse(&machine(r#"{"name":"M","type":"marker","s_start":1,"length":0}"#), "toy.json").unwrap();
        let lengths: Vec<f64> = ring.elements.iter().map(|e| e.length).collect();
        assert_eq!(lengths, [1.0, 0.0, 2.0]);
    }
}
