//! A ring as a list of elements, read from a machine file (`docs/machine.md`).

use std::path::Path;

use serde::Deserialize;

/// Transverse plane.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
pub enum Plane {
    /// Horizontal, x outward.
    #[serde(rename = "H")]
    X,
    /// Vertical, y up.
    #[serde(rename = "V")]
    Y,
}

/// Shift and roll of an element's own frame.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Misalignment {
    /// Horizontal shift [m].
    pub dx: f64,
    /// Vertical shift [m].
    pub dy: f64,
    /// Rotation about the beam axis, positive from x to y [rad].
    pub roll: f64,
}

impl Misalignment {
    /// True for an element in its place.
    pub fn is_none(&self) -> bool {
        *self == Self::default()
    }
}

/// A sector dipole.
#[derive(Debug, Clone, PartialEq)]
pub struct Bend {
    /// Curvature of the reference orbit, and of the field [1/m].
    pub curvature: f64,
    /// Gradient of the body [1/m^2].
    pub k1: f64,
    /// Entrance edge angle [rad], MAD's e1.
    pub e1: f64,
    /// Exit edge angle [rad], MAD's e2.
    pub e2: f64,
    /// Soft-edge integral times full gap, `2 fint hgap` [m].
    pub fringe: f64,
}

/// What an element does to the beam.
#[derive(Debug, Clone, PartialEq)]
pub enum Kind {
    /// Field-free space.
    Drift,
    /// A named place.
    Marker,
    /// Beam position monitor.
    Monitor {
        /// The plane it reads.
        plane: Plane,
    },
    /// Thin steering magnet.
    Corrector {
        /// The plane it kicks in.
        plane: Plane,
        /// Kick in x and y [rad].
        kick: [f64; 2],
    },
    /// Quadrupole of gradient `k1` [1/m^2], focusing in x if positive.
    Quadrupole {
        /// Gradient over the rigidity [1/m^2].
        k1: f64,
    },
    /// Sector dipole.
    Bend(Bend),
    /// Sextupole of `k2` [1/m^3].
    Sextupole {
        /// Second derivative of the field over the rigidity [1/m^3].
        k2: f64,
    },
    /// Thin multipole.
    Multipole {
        /// Integrated gradient [1/m].
        k1l: f64,
        /// Integrated skew gradient [1/m], `x' += k1sl y`, `y' += k1sl x`.
        k1sl: f64,
        /// Integrated sextupole [1/m^2].
        k2l: f64,
    },
    /// Thin octupole, `x' -= K3L (x^3 - 3 x y^2)/6`, `y' -= K3L (y^3 - 3 x^2 y)/6`; no machine file has one yet.
    Octupole {
        /// Integrated third derivative of the field over the rigidity [1/m^3].
        k3l: f64,
    },
    /// Solenoid of field over rigidity `ks` [1/m].
    Solenoid {
        /// Field over the rigidity [1/m].
        ks: f64,
    },
}

/// One element of a ring.
#[derive(Debug, Clone, PartialEq)]
pub struct Element {
    /// Name in the machine file; drifts that fill the gaps have none.
    pub name: String,
    /// What it does.
    pub kind: Kind,
    /// Position of its entrance [m].
    pub s: f64,
    /// Length along the reference orbit [m].
    pub length: f64,
    /// Shift and roll.
    pub misalignment: Misalignment,
}

impl Element {
    /// The half-cell in the name: `D8` of `QH_D8`.
    pub fn cell(&self) -> &str {
        self.name.split_once('_').map_or(&self.name, |(_, cell)| cell)
    }
}

/// The particle at the reference momentum.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Particle {
    /// Rest energy [GeV].
    pub rest_energy: f64,
    /// Kinetic energy [GeV].
    pub kinetic_energy: f64,
}

impl Particle {
    /// Lorentz factor at momentum `1 + delta` times the reference.
    pub fn gamma(&self, delta: f64) -> f64 {
        let gamma0 = 1.0 + self.kinetic_energy / self.rest_energy;
        (1.0 + (gamma0 * gamma0 - 1.0) * (1.0 + delta) * (1.0 + delta)).sqrt()
    }

    /// Speed over that of light at momentum `1 + delta` times the reference.
    pub fn beta(&self, delta: f64) -> f64 {
        let gamma = self.gamma(delta);
        (1.0 - 1.0 / (gamma * gamma)).sqrt()
    }
}

/// A ring: elements in beam order without gaps, and which of them the work is about.
#[derive(Debug, Clone)]
pub struct Ring {
    /// Name of the machine.
    pub name: String,
    /// Length of the reference orbit [m].
    pub circumference: f64,
    /// Elements in beam order; gaps are filled with drifts.
    pub elements: Vec<Element>,
    /// Reference particle.
    pub particle: Particle,
    /// Indices of the quadrupoles that carry a var: focusing ones in beam order, then defocusing ones.
    pub quadrupoles: Vec<usize>,
    /// Indices of all monitors: horizontal in beam order, then vertical.
    pub monitors: Vec<usize>,
    /// Indices of the monitors that are read, same order.
    pub read_monitors: Vec<usize>,
    /// Indices of all correctors: horizontal in beam order, then vertical.
    pub correctors: Vec<usize>,
}

/// Why a machine file is refused.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum LatticeError {
    /// The file cannot be read.
    #[error("{path}: {source}")]
    Read {
        /// The file.
        path: String,
        /// The system's reason.
        source: std::io::Error,
    },
    /// Not the JSON that docs/machine.md describes.
    #[error("{path}: {source}")]
    Syntax {
        /// The file.
        path: String,
        /// Position and reason.
        source: serde_json::Error,
    },
    /// An element starts before the one in front of it ends.
    #[error("element {name} starts at {start} m, before {before} ends at {end} m")]
    Overlap {
        /// The element.
        name: String,
        /// Its start [m].
        start: f64,
        /// The element in front.
        before: String,
        /// Where that one ends [m].
        end: f64,
    },
    /// The last element ends beyond the circumference.
    #[error("elements end at {end} m, beyond the circumference of {circumference} m")]
    TooLong {
        /// End of the last element [m].
        end: f64,
        /// Stated circumference [m].
        circumference: f64,
    },
    /// A field that this type of element needs is missing or not finite.
    #[error("{name}: expected {field}, found {found}")]
    Field {
        /// The element.
        name: String,
        /// The field.
        field: &'static str,
        /// What stands there.
        found: String,
    },
    /// Two elements of one name.
    #[error("element {name}: a second element of this name, at {s} m")]
    Duplicate {
        /// The name.
        name: String,
        /// Where the second one starts [m].
        s: f64,
    },
    /// A length that this type of element cannot have.
    #[error("element {name}: expected {expected}, found a length of {found} m")]
    Length {
        /// The element.
        name: String,
        /// What it can have.
        expected: &'static str,
        /// What stands there [m].
        found: f64,
    },
    /// An unknown element type.
    #[error("element {name}: unknown type {found:?}")]
    Type {
        /// The element.
        name: String,
        /// The type it states.
        found: String,
    },
    /// A place that the machine does not have.
    #[error("no {what} {name:?} in {machine}")]
    NoSuchPlace {
        /// Sort of place.
        what: &'static str,
        /// The name that was asked for.
        name: String,
        /// The machine.
        machine: String,
    },
}

#[derive(Deserialize)]
struct MachineFile {
    name: String,
    circumference_m: f64,
    k1: std::collections::BTreeMap<String, f64>,
    reference: Reference,
    data: MonitorLists,
    elements: Vec<ElementEntry>,
}

#[derive(Deserialize)]
struct Reference {
    particle: String,
    #[serde(rename = "kinetic_energy_GeV")]
    kinetic_energy: f64,
}

#[derive(Deserialize)]
struct MonitorLists {
    bpm_x: Vec<String>,
    bpm_y: Vec<String>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct ElementEntry {
    name: String,
    #[serde(rename = "type")]
    kind: String,
    s_start: f64,
    length: f64,
    plane: Option<Plane>,
    family: Option<String>,
    k1: Option<f64>,
    k2: Option<f64>,
    k1l: Option<f64>,
    k1sl: Option<f64>,
    k2l: Option<f64>,
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

/// Rest energies of the particles that a machine file may name [GeV] (CODATA 2018).
const REST_ENERGY: [(&str, f64); 2] = [("proton", 0.938_272_088_16), ("electron", 0.510_998_95e-3)];

/// Largest gap or overlap between neighbours that counts as rounding of the file's numbers [m].
const ROUNDING: f64 = 1e-6;

impl Ring {
    /// The AGS Booster of `machines/booster.json`.
    pub fn booster() -> Self {
        Self::parse(include_str!("../../machines/booster.json"), "booster.json")
            .expect("the built-in machine file is tested")
    }

    /// Read a machine file.
    ///
    /// # Errors
    /// [`LatticeError`], naming the element and the numbers that disagree.
    pub fn read(path: &Path) -> Result<Self, LatticeError> {
        let shown = path.display().to_string();
        let text =
            std::fs::read_to_string(path).map_err(|source| LatticeError::Read { path: shown.clone(), source })?;
        Self::parse(&text, &shown)
    }

    /// Read the text of a machine file; `path` appears in errors.
    ///
    /// # Errors
    /// As [`Ring::read`].
    pub fn parse(text: &str, path: &str) -> Result<Self, LatticeError> {
        let file: MachineFile =
            serde_json::from_str(text).map_err(|source| LatticeError::Syntax { path: path.into(), source })?;
        let rest_energy = REST_ENERGY.iter().find(|(name, _)| *name == file.reference.particle).map(|p| p.1);
        let rest_energy = rest_energy.ok_or_else(|| LatticeError::Field {
            name: file.name.clone(),
            field: "reference.particle proton or electron",
            found: file.reference.particle.clone(),
        })?;
        let energy = file.reference.kinetic_energy;
        if !(energy > 0.0 && energy.is_finite()) {
            let field = "a reference.kinetic_energy_GeV above 0";
            return Err(LatticeError::Field { name: file.name, field, found: energy.to_string() });
        }
        let mut elements = Vec::new();
        for entry in &file.elements {
            append(&mut elements, entry.element(&file.k1)?)?;
        }
        close(&mut elements, file.circumference_m)?;
        let mut ring = Self {
            particle: Particle { rest_energy, kinetic_energy: energy },
            name: file.name,
            circumference: file.circumference_m,
            elements,
            quadrupoles: Vec::new(),
            monitors: Vec::new(),
            read_monitors: Vec::new(),
            correctors: Vec::new(),
        };
        ring.index();
        for (plane, names) in [(Plane::X, &file.data.bpm_x), (Plane::Y, &file.data.bpm_y)] {
            for name in names {
                ring.read_monitors.push(ring.monitor(plane, name)?);
            }
        }
        Ok(ring)
    }

    fn index(&mut self) {
        self.quadrupoles = self.both(|kind, plane| match kind {
            Kind::Quadrupole { k1 } => (*k1 > 0.0) == (plane == Plane::X),
            _ => false,
        });
        self.monitors = self.both(|kind, plane| matches!(kind, Kind::Monitor { plane: p } if *p == plane));
        self.correctors = self.both(|kind, plane| matches!(kind, Kind::Corrector { plane: p, .. } if *p == plane));
    }

    fn both(&self, is: impl Fn(&Kind, Plane) -> bool) -> Vec<usize> {
        let of = |plane| self.elements.iter().enumerate().filter(|(_, e)| is(&e.kind, plane)).map(|(i, _)| i).collect();
        let planes: [Vec<usize>; 2] = [Plane::X, Plane::Y].map(of);
        planes.concat()
    }

    /// Index of the element of this exact name.
    ///
    /// # Errors
    /// [`LatticeError::NoSuchPlace`].
    pub fn element(&self, name: &str) -> Result<usize, LatticeError> {
        self.find("element", name, |e| e.name == name)
    }

    /// Index of a monitor by plane and half-cell.
    ///
    /// # Errors
    /// [`LatticeError::NoSuchPlace`].
    pub fn monitor(&self, plane: Plane, cell: &str) -> Result<usize, LatticeError> {
        let what = if plane == Plane::X { "horizontal monitor" } else { "vertical monitor" };
        self.find(what, cell, |e| e.cell() == cell && matches!(e.kind, Kind::Monitor { plane: p } if p == plane))
    }

    /// Index of a corrector by plane and half-cell.
    ///
    /// # Errors
    /// [`LatticeError::NoSuchPlace`].
    pub fn corrector(&self, plane: Plane, cell: &str) -> Result<usize, LatticeError> {
        let what = if plane == Plane::X { "horizontal corrector" } else { "vertical corrector" };
        self.find(what, cell, |e| e.cell() == cell && matches!(e.kind, Kind::Corrector { plane: p, .. } if p == plane))
    }

    /// Index of a quadrupole by half-cell.
    ///
    /// # Errors
    /// [`LatticeError::NoSuchPlace`].
    pub fn quadrupole(&self, cell: &str) -> Result<usize, LatticeError> {
        self.find("quadrupole", cell, |e| e.cell() == cell && matches!(e.kind, Kind::Quadrupole { .. }))
    }

    fn find(&self, what: &'static str, name: &str, is: impl Fn(&Element) -> bool) -> Result<usize, LatticeError> {
        self.elements.iter().position(is).ok_or_else(|| LatticeError::NoSuchPlace {
            what,
            name: name.into(),
            machine: self.name.clone(),
        })
    }

    /// Half-cell names of the vars, in order.
    pub fn var_names(&self) -> Vec<String> {
        self.cells(&self.quadrupoles)
    }

    /// Names of the monitors that are read, with their plane: `x_A6` ... `y_F7`.
    pub fn monitor_names(&self) -> Vec<String> {
        let name = |&i: &usize| match self.elements[i].kind {
            Kind::Monitor { plane: Plane::Y } => format!("y_{}", self.elements[i].cell()),
            _ => format!("x_{}", self.elements[i].cell()),
        };
        self.read_monitors.iter().map(name).collect()
    }

    /// Plane of each monitor that is read, and its index among [`Ring::monitors`].
    pub fn read_places(&self) -> Vec<(Plane, usize)> {
        let place = |&at: &usize| {
            let plane = match self.elements[at].kind {
                Kind::Monitor { plane } => plane,
                _ => unreachable!("the list holds monitors"),
            };
            (plane, self.monitors.iter().position(|&i| i == at).expect("a read monitor is a monitor"))
        };
        self.read_monitors.iter().map(place).collect()
    }

    /// Half-cell names of elements.
    pub fn cells(&self, elements: &[usize]) -> Vec<String> {
        elements.iter().map(|&i| self.elements[i].cell().to_owned()).collect()
    }

    /// Design gradient of each quadrupole that carries a var [1/m^2].
    pub fn gradients(&self) -> Vec<f64> {
        self.quadrupoles.iter().map(|&i| self.k1(i)).collect()
    }

    pub(crate) fn k1(&self, element: usize) -> f64 {
        match self.elements[element].kind {
            Kind::Quadrupole { k1 } => k1,
            _ => unreachable!("only quadrupoles carry a var"),
        }
    }

    /// The same ring with each quadrupole's gradient multiplied by its factor (shape `[N]`, order of [`Ring::quadrupoles`]).
    ///
    /// # Panics
    /// If there is not one var for each quadrupole.
    pub fn with_vars(&self, vars: &[f64]) -> Self {
        assert_eq!(vars.len(), self.quadrupoles.len(), "one var for each quadrupole");
        let mut ring = self.clone();
        for (&at, var) in self.quadrupoles.iter().zip(vars) {
            ring.elements[at].kind = Kind::Quadrupole { k1: self.k1(at) * var };
        }
        ring
    }
}

impl ElementEntry {
    fn element(&self, families: &std::collections::BTreeMap<String, f64>) -> Result<Element, LatticeError> {
        let length = self.finite("a finite length", Some(self.length))?;
        self.check_length(length)?;
        let family = self.family.as_ref().and_then(|f| families.get(f)).copied();
        let or_zero = |field, value: Option<f64>| self.finite(field, Some(value.unwrap_or(0.0)));
        let kind = match self.kind.as_str() {
            "marker" => Kind::Marker,
            "bpm" => Kind::Monitor { plane: self.plane()? },
            "corrector" => Kind::Corrector { plane: self.plane()?, kick: [0.0; 2] },
            "quadrupole" => {
                Kind::Quadrupole { k1: self.finite("a finite k1, or a family in the file's k1", self.k1.or(family))? }
            }
            "sextupole" => Kind::Sextupole { k2: or_zero("a finite k2", self.k2)? },
            "multipole" => Kind::Multipole {
                k1l: or_zero("a finite k1l", self.k1l)?,
                k1sl: or_zero("a finite k1sl", self.k1sl)?,
                k2l: or_zero("a finite k2l", self.k2l)?,
            },
            "solenoid" => Kind::Solenoid { ks: self.finite("a finite ks", self.ks)? },
            "sbend" => Kind::Bend(Bend {
                curvature: self.finite("a finite angle", self.angle)? / length,
                k1: or_zero("a finite k1", self.k1)?,
                e1: or_zero("a finite e1", self.e1)?,
                e2: or_zero("a finite e2", self.e2)?,
                fringe: 2.0 * or_zero("a finite fint", self.fint)? * or_zero("a finite hgap", self.hgap)?,
            }),
            found => return Err(LatticeError::Type { name: self.name.clone(), found: found.into() }),
        };
        Ok(Element {
            name: self.name.clone(),
            kind,
            s: self.finite("a finite s_start", Some(self.s_start))?,
            length,
            misalignment: Misalignment {
                dx: or_zero("a finite dx", self.dx)?,
                dy: or_zero("a finite dy", self.dy)?,
                roll: or_zero("a finite roll", self.roll)?,
            },
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

    fn plane(&self) -> Result<Plane, LatticeError> {
        self.plane.ok_or_else(|| LatticeError::Field {
            name: self.name.clone(),
            field: "a plane H or V",
            found: "nothing".into(),
        })
    }
}

/// Append an element, with a drift in front of it if there is a gap.
fn append(elements: &mut Vec<Element>, element: Element) -> Result<(), LatticeError> {
    let (end, before) = elements.last().map_or((0.0, "the start".into()), |e| (e.s + e.length, e.name.clone()));
    let gap = element.s - end;
    if gap < -ROUNDING {
        return Err(LatticeError::Overlap { name: element.name, start: element.s, before, end });
    }
    if elements.iter().any(|e| e.name == element.name) {
        return Err(LatticeError::Duplicate { name: element.name, s: element.s });
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
        elements.push(Element {
            name: String::new(),
            kind: Kind::Drift,
            s,
            length,
            misalignment: Misalignment::default(),
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_booster_closes_and_has_its_magnets() {
        let ring = Ring::booster();
        let length: f64 = ring.elements.iter().map(|e| e.length).sum();
        assert!((length - 201.78).abs() < 1e-8, "{length}"); // nine decimals in the file, 240 elements
        let angle: f64 = ring
            .elements
            .iter()
            .filter_map(|e| if let Kind::Bend(b) = &e.kind { Some(b.curvature * e.length) } else { None })
            .sum();
        assert!((angle - core::f64::consts::TAU).abs() < 1e-12);
        assert_eq!((ring.quadrupoles.len(), ring.correctors.len(), ring.read_monitors.len()), (48, 48, 33));
        assert_eq!(ring.var_names()[0], "A2");
        assert_eq!(ring.var_names()[24], "A1");
        assert_eq!(ring.monitor_names()[5], "x_C6");
    }

    fn machine(elements: &str) -> String {
        format!(
            r#"{{"name":"toy","circumference_m":3.0,"k1":{{}},"reference":{{"particle":"proton","kinetic_energy_GeV":1.0}},
               "data":{{"bpm_x":[],"bpm_y":[]}},"elements":[{elements}]}}"#
        )
    }

    #[test]
    fn a_bad_machine_file_says_what_disagrees() {
        let cases = [
            (
                r#"{"name":"Q","type":"quadrupole","s_start":0,"length":1}"#,
                "Q: expected a finite k1, or a family in the file's k1, found nothing",
            ),
            (r#"{"name":"U","type":"undulator","s_start":0,"length":1}"#, "element U: unknown type \"undulator\""),
            (
                r#"{"name":"A","type":"marker","s_start":0,"length":1},{"name":"B","type":"marker","s_start":0.5,"length":0}"#,
                "element B starts at 0.5 m, before A ends at 1 m",
            ),
            (
                r#"{"name":"A","type":"marker","s_start":2.5,"length":1}"#,
                "elements end at 3.5 m, beyond the circumference of 3 m",
            ),
            (r#"{"name":"C","type":"corrector","s_start":0,"length":0}"#, "C: expected a plane H or V, found nothing"),
        ];
        for (elements, message) in cases {
            assert_eq!(Ring::parse(&machine(elements), "toy.json").unwrap_err().to_string(), message);
        }
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
