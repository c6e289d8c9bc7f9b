//! `header.toml`: what holds for every frame.
//!
//! The file is read strictly by its format, checked against the ring, and resolved: what it says by name becomes one number
//! for each instrument and supply of the ring.

use core::fmt;
use core::marker::PhantomData;
use core::ops::Range;
use std::borrow::Cow;
use std::collections::BTreeMap;
use std::path::Path;

use serde::de::value::{MapAccessDeserializer, SeqAccessDeserializer};
use serde::de::{self, DeserializeOwned, Error as _, IntoDeserializer, MapAccess, SeqAccess, Unexpected, Visitor};
use serde::{Deserialize, Deserializer, Serialize};
use twin::limits::SETTINGS;
use twin::{Currents, Effect, EffectError, EffectKind, Holding, MagnetLaw, Rf, Ring};

use super::error::{Part, Place, RecordingError};
use super::limit::{POSITIVE, from_milli, in_milli};
use super::names::{Names, feeds};
use super::ramp::{Nominal, Ramp};

/// What `header.toml` says about the whole campaign.
#[derive(Debug, Clone, PartialEq)]
pub struct Header {
    /// How the files are written.
    pub format: Format,
    /// The machine's name.
    pub machine: String,
    /// File name of the machine's lattice.
    pub lattice: String,
    /// The front end or code that wrote the frames.
    pub recorded_with: String,
    /// Particle species.
    pub particle: String,
    /// Kinetic energy when the orbit is read [GeV].
    pub kinetic_energy: f64,
    /// Expected sigma of one reading of each monitor [B] [m].
    pub noise: Vec<f64>,
    /// Kick per current of each corrector [C] [rad/A].
    pub kick_per_ampere: Vec<f64>,
    /// How settings follow each other, in words.
    pub kick_convention: String,
    /// What the operators believe held the beam.
    pub believed_rf: BelievedRf,
    /// Dipole current at which the lattice has its design momentum [A]; none if it is not recorded.
    pub nominal_dipole: Option<f64>,
    /// Supply currents at which the lattice has its design strengths [F] [A].
    pub nominal: Vec<f64>,
    /// Coefficients `c_n` of each supply's transfer function `p(r) = sum of c_n r^n`, from `n = 0`, `p(1) != 0` [F] [1].
    ///
    /// `k1 = var k1_design p(I/I_nominal)/p(1)/(I_dipole/I_dipole_nominal)`
    pub transfer: Vec<Vec<f64>>,
    /// The same of the dipoles' field; `[0, 1]` where the machine file states no law of it [1].
    pub dipole_transfer: Vec<f64>,
    /// The two monitors whose mean a radial loop holds, horizontal ones of the machine; always present where one is believed on.
    pub radial_loop_monitors: Option<[String; 2]>,
    /// Remarks.
    pub note: String,
    /// What changes along the ramp, from the machine file.
    pub ramp: Ramp,
}

/// How a recording's files are written.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// One supply of all focusing and one of all other quadrupoles, one constant for all correctors and one for all
    /// monitors, all columns in their order.
    One,
    /// Supplies, correctors and monitors by name, columns in any order.
    Two,
}

/// What is believed to stay constant while the correctors move.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum BelievedRf {
    /// The momentum.
    FixedMomentum,
    /// The RF frequency, hence the path length.
    FixedFrequency,
    /// The mean of two horizontal monitors.
    RadialLoop,
}

/// The file, whose nominal currents, transfer functions and numbers of single instruments differ from format to format.
#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct HeaderFile<N, T, P> {
    #[serde(default)]
    format: Option<i64>,
    machine: String,
    lattice: String,
    recorded_with: String,
    particle: String,
    #[serde(rename = "kinetic_energy_GeV")]
    kinetic_energy: Positive,
    #[serde(rename = "bpm_sigma_mm")]
    noise: P,
    #[serde(rename = "kick_mrad_per_A")]
    kick_per_ampere: Option<P>,
    kick_convention: String,
    believed_rf: BelievedRf,
    #[serde(rename = "nominal_A")]
    nominal: Option<N>,
    quad_transfer: Option<T>,
    #[serde(default, deserialize_with = "pair", skip_serializing_if = "Option::is_none")]
    radial_loop_monitors: Option<[String; 2]>,
    #[serde(default, skip_serializing_if = "String::is_empty")]
    note: String,
}

type First = HeaderFile<TwoSupplies, Transfer, Positive>;
type Second = HeaderFile<BTreeMap<String, Positive>, PerName<Transfer>, PerName<Positive>>;

/// Nominal currents of format 1.
#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct TwoSupplies {
    dipole: Positive,
    qh: Positive,
    qv: Positive,
}

/// A positive finite number.
#[derive(Clone, Copy, Serialize)]
struct Positive(f64);

/// Coefficients with a sum that is not 0.
#[derive(Clone, Serialize)]
struct Transfer(Vec<f64>);

/// One value for all, or values by name: of supplies, or of instruments with a default.
#[derive(Serialize)]
#[serde(untagged)]
enum PerName<V> {
    All(V),
    Each(BTreeMap<String, V>),
}

/// A value that is stated so.
trait Stated: DeserializeOwned {
    /// What is expected, in words.
    const EITHER: &str;
}

/// The key of the number that holds for all instruments that are not named.
const DEFAULT: &str = "default";

impl Header {
    /// Read the header of a campaign that is still to be taken.
    ///
    /// # Errors
    /// [`RecordingError`], the first fault met.
    pub fn read(file: &Path, ring: &Ring) -> Result<Self, RecordingError> {
        let text = super::text(file, SETTINGS)?;
        let text = Text { file, text: &text };
        let ring = super::powered(ring, text.format()?);
        Self::parse(&text, &ring, &Names::from_ring(&ring))
    }

    pub(super) fn parse(text: &Text, ring: &Ring, names: &Names) -> Result<Self, RecordingError> {
        text.check_names(ring)?;
        let mut header = match text.format()? {
            Format::One => text.first(ring)?,
            Format::Two => text.second(ring, names)?,
        };
        if header.believed_rf == BelievedRf::RadialLoop && header.radial_loop_monitors.is_none() {
            return Err(text.refuse(0..0, "missing field `radial_loop_monitors`, needed as believed_rf is radial_loop"));
        }
        text.check_machine(&header, ring)?;
        text.check_currents(&mut header, ring)?;
        text.check_loop(&header, ring)?;
        let gradient = |supply, current| header.gradient(supply, current);
        let nominal = Nominal { dipole: header.nominal_dipole, supply: &header.nominal, gradient: &gradient };
        header.ramp = Ramp::from_ring(ring, &nominal).map_err(|(key, what)| text.refuse_key(key, &what))?;
        text.check_ramp(&header)?;
        Ok(header)
    }

    /// Gradient of a supply's quadrupoles over that at its nominal current: `p(I/I_nominal)/p(1)`.
    pub fn gradient(&self, supply: usize, current: f64) -> f64 {
        relative(&self.transfer[supply], current / self.nominal[supply])
    }

    /// Field of the dipoles over that at their nominal current; none where their current is not recorded.
    pub fn dipole_field(&self, current: f64) -> Option<f64> {
        self.nominal_dipole.map(|nominal| relative(&self.dipole_transfer, current / nominal))
    }

    /// What is believed to be held while correctors kick.
    ///
    /// # Errors
    /// [`EffectError`] if the ring does not have the monitors of a radial loop.
    ///
    /// # Panics
    /// If a radial loop is believed on and its monitors are not known, which no header that was read is.
    pub fn believed(&self, ring: &Ring) -> Result<Holding, EffectError> {
        match self.believed_rf {
            BelievedRf::FixedMomentum => Ok(Rf::FixedMomentum.into()),
            BelievedRf::FixedFrequency => Ok(Rf::FixedFrequency.into()),
            BelievedRf::RadialLoop => {
                let known = self.radial_loop(ring).expect("where a loop is believed on its monitors are known");
                Holding::radial_loop(ring, known?.site)
            }
        }
    }

    /// The loop that would hold the monitors that are named, if they are.
    pub fn radial_loop(&self, ring: &Ring) -> Option<Result<Effect, EffectError>> {
        let pair = self.radial_loop_monitors.as_ref()?;
        Some(Effect::at(EffectKind::RadialLoop, &pair.join(","), 1.0, ring))
    }

    /// The file's text, in format 2.
    pub(super) fn text(&self, names: &Names) -> String {
        let by_name = |names: &[String], values: &[f64], scale: fn(f64) -> f64| {
            let default = values.first().copied().unwrap_or(1.0);
            let others = names.iter().zip(values).filter(|(_, value)| **value != default);
            let mut each: BTreeMap<String, Positive> =
                others.map(|(name, value)| (name.clone(), Positive(scale(*value)))).collect();
            if each.is_empty() {
                return PerName::All(Positive(scale(default)));
            }
            each.insert(DEFAULT.into(), Positive(scale(default)));
            PerName::Each(each)
        };
        let supplies = names.supplies.iter().zip(&self.nominal).map(|(name, nominal)| (name.clone(), *nominal));
        let dipole = self.nominal_dipole.map(|nominal| ("dipole".to_owned(), nominal));
        let transfer = |(name, transfer): (&String, &Vec<f64>)| (name.clone(), Transfer(transfer.clone()));
        let alike = self.transfer.windows(2).all(|pair| pair[0] == pair[1]);
        let file: Second = HeaderFile {
            format: Some(2),
            machine: self.machine.clone(),
            lattice: self.lattice.clone(),
            recorded_with: self.recorded_with.clone(),
            particle: self.particle.clone(),
            kinetic_energy: Positive(self.kinetic_energy),
            noise: by_name(&names.monitors, &self.noise, in_milli),
            kick_per_ampere: Some(by_name(&names.correctors, &self.kick_per_ampere, in_milli)),
            kick_convention: self.kick_convention.clone(),
            believed_rf: self.believed_rf,
            nominal: Some(
                dipole.into_iter().chain(supplies).map(|(name, nominal)| (name, Positive(nominal))).collect(),
            ),
            quad_transfer: Some(match self.transfer.first() {
                Some(first) if alike => PerName::All(Transfer(first.clone())),
                _ => PerName::Each(names.supplies.iter().zip(&self.transfer).map(transfer).collect()),
            }),
            radial_loop_monitors: self.radial_loop_monitors.clone(),
            note: self.note.clone(),
        };
        toml::to_string(&file).expect("texts, numbers and tables of them are TOML")
    }
}

/// A header as text, and where it comes from.
pub(super) struct Text<'a> {
    pub file: &'a Path,
    pub text: &'a str,
}

impl Text<'_> {
    /// How the recording is written.
    pub fn format(&self) -> Result<Format, RecordingError> {
        #[derive(Deserialize)]
        struct Probe {
            format: Option<toml::Spanned<toml::Value>>,
        }
        // what is wrong elsewhere is found by the strict reading
        let Ok(Probe { format: Some(format) }) = toml::from_str(self.text) else { return Ok(Format::One) };
        match format.get_ref().as_integer() {
            Some(1) => Ok(Format::One),
            Some(2) => Ok(Format::Two),
            _ => Err(self.refuse(format.span(), &format!("expected 1 or 2, found {}", format.get_ref()))),
        }
    }

    fn first(&self, ring: &Ring) -> Result<Header, RecordingError> {
        let file: First = self.strict()?;
        let stated = self.needed("nominal_A", file.nominal)?;
        let nominal = [stated.qh, stated.qv];
        let kick_per_ampere = self.needed("kick_mrad_per_A", file.kick_per_ampere)?;
        Ok(Header {
            format: Format::One,
            machine: file.machine,
            lattice: file.lattice,
            recorded_with: file.recorded_with,
            particle: file.particle,
            kinetic_energy: file.kinetic_energy.0,
            noise: vec![from_milli(file.noise.0); ring.read_monitors.len()],
            kick_per_ampere: vec![from_milli(kick_per_ampere.0); ring.correctors.len()],
            kick_convention: file.kick_convention,
            believed_rf: file.believed_rf,
            nominal_dipole: Some(stated.dipole.0),
            nominal: feeds(ring).into_iter().map(|feed| nominal[feed].0).collect(),
            transfer: vec![self.needed("quad_transfer", file.quad_transfer)?.0; ring.supplies.len()],
            dipole_transfer: PROPORTIONAL.into(),
            radial_loop_monitors: file.radial_loop_monitors,
            note: file.note,
            ramp: Ramp::default(),
        })
    }

    fn second(&self, ring: &Ring, names: &Names) -> Result<Header, RecordingError> {
        let file: Second = self.strict()?;
        let law = ring.currents.as_ref();
        let per_monitor = |name: &str| names.monitor(name);
        let per_corrector = |name: &str| names.corrector(name);
        let (monitors, correctors) = (names.monitors.len(), names.correctors.len());
        let mut nominal = self.needed("nominal_A", file.nominal.or_else(|| Some(nominal_by(law?))))?;
        let nominal_dipole = nominal.remove("dipole").map(|nominal| nominal.0);
        let nominal: Vec<f64> =
            self.by_supply("nominal_A", &names.supplies, nominal)?.into_iter().map(|Positive(a)| a).collect();
        let transfer = match self.needed("quad_transfer", file.quad_transfer.or_else(|| Some(transfer_by(law?))))? {
            PerName::All(transfer) => vec![transfer; names.supplies.len()],
            PerName::Each(each) => self.by_supply("quad_transfer", &names.supplies, each)?,
        };
        let kick = file.kick_per_ampere.or_else(|| Some(PerName::All(Positive(in_milli(law?.kick_per_ampere())))));
        let kick = self.needed("kick_mrad_per_A", kick)?;
        Ok(Header {
            format: Format::Two,
            machine: file.machine,
            lattice: file.lattice,
            recorded_with: file.recorded_with,
            particle: file.particle,
            kinetic_energy: file.kinetic_energy.0,
            noise: self.by_name("bpm_sigma_mm", file.noise, monitors, per_monitor)?,
            kick_per_ampere: self.by_name("kick_mrad_per_A", kick, correctors, per_corrector)?,
            kick_convention: file.kick_convention,
            believed_rf: file.believed_rf,
            nominal_dipole,
            nominal,
            transfer: transfer.into_iter().map(|Transfer(c)| c).collect(),
            dipole_transfer: PROPORTIONAL.into(),
            radial_loop_monitors: file.radial_loop_monitors,
            note: file.note,
            ramp: Ramp::default(),
        })
    }

    fn strict<'de, T: Deserialize<'de>>(&'de self) -> Result<T, RecordingError> {
        toml::from_str(self.text).map_err(|error| self.refuse(error.span().unwrap_or_default(), error.message()))
    }

    /// A value of every supply.
    fn by_supply<T>(
        &self,
        key: &str,
        supplies: &[String],
        mut each: BTreeMap<String, T>,
    ) -> Result<Vec<T>, RecordingError> {
        let take = |supply: &String| {
            each.remove(supply)
                .ok_or_else(|| self.refuse_key(key, &format!("missing field `{supply}`, a supply of the machine")))
        };
        let values = supplies.iter().map(take).collect::<Result<Vec<T>, _>>()?;
        match each.keys().next() {
            Some(unknown) => {
                Err(self.refuse_key(key, &format!("unknown field `{unknown}`, the machine has no such supply")))
            }
            None => Ok(values),
        }
    }

    /// A number for every instrument, in SI units.
    fn by_name(
        &self,
        key: &str,
        per_name: PerName<Positive>,
        instruments: usize,
        index: impl Fn(&str) -> Option<usize>,
    ) -> Result<Vec<f64>, RecordingError> {
        let mut each = match per_name {
            PerName::All(Positive(value)) => return Ok(vec![from_milli(value); instruments]),
            PerName::Each(each) => each,
        };
        let mut values = vec![each.remove(DEFAULT).map(|Positive(value)| from_milli(value)); instruments];
        for (name, Positive(value)) in &each {
            let at = index(name);
            let unknown =
                || self.refuse_key(key, &format!("unknown field `{name}`, the machine has no such instrument"));
            values[at.ok_or_else(unknown)?] = Some(from_milli(*value));
        }
        let missing = || self.refuse_key(key, "missing field `default`, as not every instrument is named");
        values.into_iter().collect::<Option<_>>().ok_or_else(missing)
    }

    /// Machine and lattice have to be the ring's, whatever else may be wrong: the header of another one lacks this one's supplies.
    fn check_names(&self, ring: &Ring) -> Result<(), RecordingError> {
        // what cannot be read the strict reading refuses
        let stated: toml::Table = self.text.parse().unwrap_or_default();
        let word = |key: &str| stated.get(key)?.as_str();
        let machine = word("machine").filter(|name| !begins(&ring.name, name));
        let lattice = word("lattice").filter(|file| *file != ring.file);
        let other = machine.map(|name| ("machine", &ring.name, name));
        match other.or_else(|| lattice.map(|file| ("lattice", &ring.file, file))) {
            Some((key, expected, found)) => self.other_machine(key, format!("{expected:?}"), format!("{found:?}")),
            None => Ok(()),
        }
    }

    /// Particle and energy have to be the ring's.
    fn check_machine(&self, header: &Header, ring: &Ring) -> Result<(), RecordingError> {
        if header.particle != ring.particle.name() {
            return self.other_machine(
                "particle",
                format!("{:?}", ring.particle.name()),
                format!("{:?}", header.particle),
            );
        }
        let (expected, found) = (ring.particle.kinetic_energy, header.kinetic_energy);
        if (found / expected - 1.0).abs() > SAME_ENERGY {
            return self.other_machine("kinetic_energy_GeV", expected, found);
        }
        Ok(())
    }

    /// What the header states has to be what the machine file's supply law makes, from which the dipoles' field is taken.
    fn check_currents(&self, header: &mut Header, ring: &Ring) -> Result<(), RecordingError> {
        let Some(law) = &ring.currents else { return Ok(()) };
        let same = |key, what: &str, expected: f64, found: f64| {
            if (found / expected - 1.0).abs() <= SAME_CURRENT {
                return Ok(());
            }
            let by_law = format!("expected {expected} {what} by the currents of {}, found {found}", ring.file);
            Err(self.refuse_key(key, &by_law))
        };
        for (f, supply) in ring.supplies.iter().enumerate() {
            let Some((nominal, magnets)) = law.supply(&supply.name).zip(law.quadrupoles.get(&supply.name)) else {
                continue;
            };
            same("nominal_A", &format!("A of supply {}", supply.name), nominal, header.nominal[f])?;
            for off in [0.99, 1.01] {
                let expected = magnets.integrated.at(off * nominal) / magnets.integrated.at(nominal);
                let what = format!("times the gradient of supply {} at {off} of its nominal current", supply.name);
                same("quad_transfer", &what, expected, header.gradient(f, off * header.nominal[f]))?;
            }
        }
        for &kick in &header.kick_per_ampere {
            same("kick_mrad_per_A", "mrad/A", in_milli(law.kick_per_ampere()), in_milli(kick))?;
        }
        if let Some(nominal) = header.nominal_dipole {
            same("nominal_A", "A of the dipoles", law.dipole_current(), nominal)?;
            header.dipole_transfer = law.dipole.field.over(nominal);
        }
        Ok(())
    }

    /// A key that only a machine file with a supply law can spare.
    fn needed<T>(&self, key: &str, value: Option<T>) -> Result<T, RecordingError> {
        value.ok_or_else(|| self.refuse(0..0, &format!("missing field `{key}`")))
    }

    /// A radial loop holds two horizontal monitors of the ring.
    fn check_loop(&self, header: &Header, ring: &Ring) -> Result<(), RecordingError> {
        let held = header.radial_loop(ring).transpose();
        held.map(drop).map_err(|error| self.refuse_key("radial_loop_monitors", &error.to_string()))
    }

    /// Along a ramp a kick at fixed frequency moves the momentum by less and less, which the model leaves out.
    fn check_ramp(&self, header: &Header) -> Result<(), RecordingError> {
        if header.ramp.is_given() && header.believed_rf == BelievedRf::FixedFrequency {
            return Err(self.refuse_key("believed_rf", "fixed_frequency is not modelled along the machine file's ramp"));
        }
        Ok(())
    }

    fn refuse(&self, span: Range<usize>, message: &str) -> RecordingError {
        let message = message.replace(['\n', '\r'], " "); // a quoted key may hold a line break
        RecordingError::Header(header_place(self.file, self.text, span), message)
    }

    /// What is wrong with the value of a key.
    pub fn refuse_key(&self, key: &str, message: &str) -> RecordingError {
        RecordingError::Header(self.key(key), message.to_owned())
    }

    /// The value of a key is that of another machine.
    fn other_machine(
        &self,
        key: &str,
        expected: impl fmt::Display,
        found: impl fmt::Display,
    ) -> Result<(), RecordingError> {
        Err(RecordingError::Machine(self.key(key).mismatch(expected, found)))
    }

    /// Where a key of the top level stands.
    fn key(&self, key: &str) -> Place {
        let is =
            |line: &str| line.trim_start().strip_prefix(key).is_some_and(|rest| rest.trim_start().starts_with('='));
        let line = self.text.lines().position(is).unwrap_or(0);
        Place::new(self.file, line + 1, Part::Key(key.into()))
    }
}

/// The ring at another kinetic energy [GeV]: its strengths are over the rigidity, and stay. With a ramp in the machine file it is as it was.
pub fn at_energy(ring: &Ring, kinetic_energy: f64) -> Cow<'_, Ring> {
    if (kinetic_energy / ring.particle.kinetic_energy - 1.0).abs() <= SAME_ENERGY || !ring.ramp.is_empty() {
        return Cow::Borrowed(ring);
    }
    let mut ring = ring.clone();
    ring.particle.kinetic_energy = kinetic_energy;
    Cow::Owned(ring)
}

/// Kinetic energy that a header states [GeV]; none where it cannot be read, which the strict reading refuses.
pub(super) fn kinetic_energy(text: &str) -> Option<f64> {
    let energy = value(text, "kinetic_energy_GeV")?.as_float()?;
    (energy.is_finite() && energy > 0.0).then_some(energy)
}

/// The lattice that a header names; none likewise.
pub(super) fn lattice(text: &str) -> Option<String> {
    Some(value(text, "lattice")?.as_str()?.to_owned())
}

fn value(text: &str, key: &str) -> Option<toml::Value> {
    text.parse::<toml::Table>().ok()?.remove(key)
}

/// Relative difference of energies that counts as rounding.
const SAME_ENERGY: f64 = 1e-6;
/// Relative difference of what a header and the machine file say of currents that counts as none: a tenth of the error bar of a var.
const SAME_CURRENT: f64 = 3e-4;
/// Transfer function of a field that goes with its current.
const PROPORTIONAL: [f64; 2] = [0.0, 1.0];

/// A transfer function over its value at the nominal current.
fn relative(transfer: &[f64], ratio: f64) -> f64 {
    let at = |ratio: f64| transfer.iter().rev().fold(0.0, |sum, c| sum * ratio + c);
    at(ratio) / at(1.0)
}

/// Nominal currents by the supply law.
fn nominal_by(law: &Currents) -> BTreeMap<String, Positive> {
    let supplies = law.quadrupoles.keys().filter_map(|name| Some((name.clone(), Positive(law.supply(name)?))));
    supplies.chain([("dipole".to_owned(), Positive(law.dipole_current()))]).collect()
}

/// Transfer functions by the supply law.
fn transfer_by(law: &Currents) -> PerName<Transfer> {
    let over = |(name, magnets): (&String, &MagnetLaw)| {
        Some((name.clone(), Transfer(magnets.integrated.over(law.supply(name)?))))
    };
    PerName::Each(law.quadrupoles.iter().filter_map(over).collect())
}

/// True if a name's words, letter case aside, are the first of the other's: `ags-booster` of `AGS Booster (BNL)`.
fn begins(whole: &str, name: &str) -> bool {
    let words = |text: &str| -> Vec<String> {
        let parts = text.split(|c: char| !c.is_alphanumeric()).filter(|word| !word.is_empty());
        parts.map(str::to_lowercase).collect()
    };
    let name = words(name);
    !name.is_empty() && words(whole).starts_with(&name)
}

/// Line of a span of the header, and the key that the span is or is the value of.
fn header_place(file: &Path, text: &str, span: Range<usize>) -> Place {
    let is_key = text[span.end..].trim_start().starts_with('=');
    let before = &text[..if is_key { span.end } else { span.start }];
    let line = before.rsplit('\n').next().unwrap_or_default();
    let left = if is_key { Some(line) } else { line.rsplit_once('=').map(|(left, _)| left) };
    let part = left.and_then(last_word).map_or(Part::Whole, |key| Part::Key(key.into()));
    Place::new(file, 1 + before.matches('\n').count(), part)
}

fn last_word(text: &str) -> Option<&str> {
    let in_key = |c: char| c.is_alphanumeric() || c == '_' || c == '-';
    text.trim_end().rsplit(|c| !in_key(c)).next().filter(|word| !word.is_empty())
}

impl<'de> Deserialize<'de> for Positive {
    fn deserialize<D: Deserializer<'de>>(value: D) -> Result<Self, D::Error> {
        let value = f64::deserialize(value)?;
        let refuse = || D::Error::invalid_value(Unexpected::Float(value), &POSITIVE.words);
        POSITIVE.check(value).map(Self).ok_or_else(refuse)
    }
}

impl<'de> Deserialize<'de> for Transfer {
    fn deserialize<D: Deserializer<'de>>(value: D) -> Result<Self, D::Error> {
        let coefficients = Vec::<f64>::deserialize(value)?;
        let nominal = 0.0 + coefficients.iter().sum::<f64>(); // p(1); an empty list sums to -0, which would puzzle a reader
        if nominal == 0.0 || !nominal.is_finite() {
            let words = &"finite coefficients with a sum p(1) that is not 0";
            return Err(D::Error::invalid_value(Unexpected::Other(&format!("p(1) = {nominal}")), words));
        }
        Ok(Self(coefficients))
    }
}

impl Stated for Positive {
    const EITHER: &str = "a number, or a table of numbers by name";
}

impl Stated for Transfer {
    const EITHER: &str = "a list of coefficients, or a table of lists by supply";
}

/// Serde's untagged enums would say neither what was expected nor where.
impl<'de, V: Stated> Deserialize<'de> for PerName<V> {
    fn deserialize<D: Deserializer<'de>>(value: D) -> Result<Self, D::Error> {
        value.deserialize_any(Either(PhantomData))
    }
}

struct Either<V>(PhantomData<V>);

impl<'de, V: Stated> Visitor<'de> for Either<V> {
    type Value = PerName<V>;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(V::EITHER)
    }

    fn visit_f64<E: de::Error>(self, value: f64) -> Result<PerName<V>, E> {
        V::deserialize(value.into_deserializer()).map(PerName::All)
    }

    fn visit_i64<E: de::Error>(self, value: i64) -> Result<PerName<V>, E> {
        self.visit_f64(value as f64)
    }

    fn visit_seq<A: SeqAccess<'de>>(self, list: A) -> Result<PerName<V>, A::Error> {
        V::deserialize(SeqAccessDeserializer::new(list)).map(PerName::All)
    }

    fn visit_map<A: MapAccess<'de>>(self, table: A) -> Result<PerName<V>, A::Error> {
        BTreeMap::deserialize(MapAccessDeserializer::new(table)).map(PerName::Each)
    }
}

/// Exactly two names: serde's own `[String; 2]` would let the header's reader drop a third in silence.
fn pair<'de, D: Deserializer<'de>>(value: D) -> Result<Option<[String; 2]>, D::Error> {
    let names = Vec::<String>::deserialize(value)?;
    let refuse = |names: Vec<String>| D::Error::invalid_length(names.len(), &"two monitors");
    names.try_into().map(Some).map_err(refuse)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_machine_is_known_by_the_first_words_of_its_name() {
        let booster = "AGS Booster (BNL), deck";
        for (name, known) in
            [("ags-booster", true), ("AGS", true), ("ags boost", false), ("", false), ("booster", false)]
        {
            assert_eq!(begins(booster, name), known, "{name}");
        }
    }
}
