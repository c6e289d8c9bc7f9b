//! A lattice by MAD-X: the table of `twiss, file=`, one row an element.
//!
//! `K1L` and the like are integrated; `E1` and `E2` are those against a sector dipole and `L` is the length of the arc, for an RBEND too; a `FINTX` of -1
//! is that of `FINT`. Frequencies are in MHz.
//!
//! Source: MAD-X User's Guide, chapters Twiss Module and Bending Magnet; the table of MAD-X 5.09.03.

use std::collections::HashMap;

use super::element::{Element, Format, Lattice, Role};
use super::fields::{NONE, Strengths, give};
use measured::MeasuredError;
use measured::folder::Particle;
use twin::limits::{FINITE, TEXT};

/// Columns that a ring needs.
const COLUMNS: [&str; 17] = [
    "NAME", "KEYWORD", "S", "L", "ANGLE", "K0L", "K1L", "K1SL", "K2L", "K3L", "E1", "E2", "FINT", "FINTX", "HGAP",
    "TILT", "KSI",
];
/// Keywords without a field that matters here.
const FIELD_FREE: [&str; 10] = [
    "MARKER",
    "DRIFT",
    "INSTRUMENT",
    "PLACEHOLDER",
    "COLLIMATOR",
    "RCOLLIMATOR",
    "ECOLLIMATOR",
    "MONITOR",
    "HMONITOR",
    "VMONITOR",
];
/// Rounding of the table's lengths [m].
const ROUNDING: f64 = 1e-6;

/// Read it.
pub(super) fn read(file: &str, text: &str) -> Result<Lattice, MeasuredError> {
    let mut lattice = Lattice::new(file, Format::Madx);
    let mut columns: HashMap<String, usize> = HashMap::new();
    let mut s = 0.0;
    for (index, line) in text.lines().enumerate() {
        if let Err(exceeded) = TEXT.check(line.len() as u64) {
            return lattice.refuse(format!("line {}: {exceeded}", index + 1));
        }
        let mut words = line.split_whitespace();
        match words.next() {
            None | Some("$") => {}
            Some("@") => header(&mut lattice, index + 1, &words.collect::<Vec<_>>())?,
            Some("*") => {
                columns = words.enumerate().map(|(place, name)| (name.to_ascii_uppercase(), place)).collect();
                complete(&lattice, &columns)?;
            }
            Some(_) if columns.is_empty() => {
                return lattice.refuse(format!("line {}: expected the names of the columns (*) first", index + 1));
            }
            Some(_) => {
                let cells = line.split_whitespace().collect();
                let row = Row { lattice: &lattice, columns: &columns, cells, line: index + 1 };
                let (one, strengths) = row.element(&mut s)?;
                if row.text("KEYWORD")? == "RFCAVITY" {
                    let rf = row.optional("FREQ")?.map(|one| one * 1e6);
                    let harmonic = row.optional("HARMON")?;
                    lattice.rf = lattice.rf.or(rf.filter(|one| *one > 0.0));
                    lattice.harmonic = lattice.harmonic.or(harmonic.filter(|one| *one > 0.0));
                }
                give(&mut lattice, one, strengths)?;
            }
        }
    }
    if lattice.elements.is_empty() {
        return lattice.refuse("the table has no rows".into());
    }
    Ok(lattice)
}

/// `@ ENERGY %le 1.5`
fn header(lattice: &mut Lattice, line: usize, words: &[&str]) -> Result<(), MeasuredError> {
    let [name, _, value, ..] = words else { return Ok(()) };
    let number = |lattice: &Lattice| {
        FINITE.parse(value).or_else(|problem| lattice.refuse(format!("line {line}: {name}: {problem}")))
    };
    match *name {
        "ENERGY" => lattice.energy = Some(number(lattice)?),
        "MASS" => {
            let mass = number(lattice)?;
            match Particle::of_rest_energy(mass) {
                Some(particle) => lattice.particle = particle,
                None => {
                    return lattice
                        .refuse(format!("line {line}: MASS {mass} GeV, expected an electron's or a proton's"));
                }
            }
        }
        "BV_FLAG" if number(lattice)? != 1.0 => {
            return lattice
                .refuse(format!("line {line}: BV_FLAG {value}, expected 1: a beam that runs along the sequence"));
        }
        _ => {}
    }
    Ok(())
}

fn complete(lattice: &Lattice, columns: &HashMap<String, usize>) -> Result<(), MeasuredError> {
    let missing: Vec<&str> = COLUMNS.into_iter().filter(|name| !columns.contains_key(*name)).collect();
    if missing.is_empty() {
        return Ok(());
    }
    let all = COLUMNS.join(",").to_lowercase();
    lattice.refuse(format!(
        "the table lacks {}; write it with `select, flag=twiss, clear; select, flag=twiss, column={all},freq,harmon;` before `twiss`",
        missing.join(", ")
    ))
}

struct Row<'a> {
    lattice: &'a Lattice,
    columns: &'a HashMap<String, usize>,
    cells: Vec<&'a str>,
    line: usize,
}

impl Row<'_> {
    fn text(&self, column: &str) -> Result<&str, MeasuredError> {
        match self.cells.get(self.columns[column]) {
            Some(cell) => Ok(cell.trim_matches('"')),
            None => self.lattice.refuse(format!("line {}: no {column}: {} cells", self.line, self.cells.len())),
        }
    }

    fn number(&self, column: &str) -> Result<f64, MeasuredError> {
        let refused = |problem| self.lattice.refuse(format!("line {}: {column}: {problem}", self.line));
        FINITE.parse(self.text(column)?).or_else(refused)
    }

    fn optional(&self, column: &str) -> Result<Option<f64>, MeasuredError> {
        self.columns.contains_key(column).then(|| self.number(column)).transpose()
    }

    /// The element of a row whose entrance is at `s`, which moves to its exit.
    fn element(&self, s: &mut f64) -> Result<(Element, Strengths), MeasuredError> {
        let (name, keyword, length, exit) =
            (self.text("NAME")?, self.text("KEYWORD")?, self.number("L")?, self.number("S")?);
        if (*s + length - exit).abs() > ROUNDING {
            return self.lattice.refuse(format!(
                "line {}: {name} of {length} m ends at {exit} m, the element before it at {s} m; expected a table of all elements, at their ends",
                self.line
            ));
        }
        *s = exit;
        let mut one =
            Element { name: name.into(), kind: keyword.into(), length, role: role(keyword), ..Element::default() };
        match keyword {
            "SBEND" | "RBEND" => self.bend(&mut one)?,
            "QUADRUPOLE" | "SEXTUPOLE" | "OCTUPOLE" | "RFCAVITY" => {}
            "MULTIPOLE" if self.number("K0L")?.abs() > NONE || self.number("ANGLE")?.abs() > NONE => {
                return self.refuse(name, "a thin dipole, expected a lattice from before MAKETHIN".into());
            }
            "MULTIPOLE" => {}
            "SOLENOID" if self.number("KSI")?.abs() < NONE => {}
            _ if FIELD_FREE.contains(&keyword) || one.role != Role::Other => {}
            _ => return self.refuse(name, format!("keyword {keyword} acts on the orbit and is not known here")),
        }
        Ok((one, self.strengths(length)?))
    }

    fn refuse<T>(&self, name: &str, problem: String) -> Result<T, MeasuredError> {
        self.lattice.refuse(format!("line {}: element {name}: {problem}", self.line))
    }

    fn bend(&self, one: &mut Element) -> Result<(), MeasuredError> {
        one.bend = self.number("ANGLE")?;
        let field = self.number("K0L")?;
        if field.abs() > NONE && (field - one.bend).abs() > 1e-9 {
            return self.refuse(&one.name, format!("K0L {field} rad, its reference orbit bends by {} rad", one.bend));
        }
        (one.edge_in, one.edge_out) = (self.number("E1")?, self.number("E2")?);
        let first = self.number("FINT")?;
        let last = Some(self.number("FINTX")?).filter(|last| *last >= 0.0).unwrap_or(first);
        let gap = 2.0 * self.number("HGAP")?;
        one.set_fringe(gap * first, gap * last);
        Ok(())
    }

    fn strengths(&self, length: f64) -> Result<Strengths, MeasuredError> {
        let per = if length > 0.0 { length } else { 1.0 };
        let of = |column: &str| Ok::<_, MeasuredError>(self.number(column)? / per);
        let kicks = [self.optional("HKICK")?, self.optional("VKICK")?];
        Ok(Strengths {
            k1: [of("K1L")?, of("K1SL")?],
            k2: [of("K2L")?, 0.0],
            is_dipole: kicks.into_iter().flatten().any(|kick| kick != 0.0),
            is_higher: self.number("K3L")?.abs() > NONE,
            tilt: self.number("TILT")?,
        })
    }
}

fn role(keyword: &str) -> Role {
    match keyword {
        "MONITOR" => Role::Monitor([true, true]),
        "HMONITOR" => Role::Monitor([true, false]),
        "VMONITOR" => Role::Monitor([false, true]),
        "KICKER" | "TKICKER" => Role::Corrector([true, true]),
        "HKICKER" => Role::Corrector([true, false]),
        "VKICKER" => Role::Corrector([false, true]),
        _ => Role::Other,
    }
}
