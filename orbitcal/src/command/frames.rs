//! `orbitcal frames`: the raw orbits of a measured response made into a recording that the core streams.

use inference::recording::{BelievedRf, Format, Header, Ramp, Recording, Row};
use measured::named::named;
use measured::{Calibrated, Fit, Folder, Model, RawOrbits, Straightened, calibrated, unknowns};
use results::{Written, model_file, output};
use training::extended;
use twin::{Effect, EffectError, EffectKind, Plane, Rf, Ring};

use super::matrix::{fitted, settings};
use super::{CommandError, check_outputs, deliver};
use crate::cli::Frames;

/// Millimetres a metre, milliradians a radian.
const MILLI: f64 = 1e-3;

/// Run it.
///
/// # Errors
/// [`CommandError`].
pub fn run(options: &Frames) -> Result<(), CommandError> {
    let out = options.out.as_path();
    if options.common.machine.is_some() {
        return Err(CommandError::Input("--machine is for a recording; the lattice is that of the folder".into()));
    }
    if out.exists() {
        return Err(CommandError::Input(format!("{} exists; it is not overwritten", out.display())));
    }
    check_outputs([options.common.json.as_deref()])?;
    let settings = settings(options.rf, &options.priors)?;
    let (as_read, raw) = read(options, settings.rf)?;
    let Straightened { folder, cables, fit: fitted } = fitted(&as_read, &settings, &options.common)?;
    let raw = raw.with_cables(&folder, &cables);
    let calibrated = Calibrated::of(&folder, &fitted);
    let ring = Ring::parse(&calibrated.machine.to_string(), &folder.name)?;
    let recording = recording(&ring, &calibrated, &raw, settings.rf)?;
    let held = held(&ring, settings.rf).map_err(CommandError::other)?;
    let model = extended::tables(&ring, &held, &vars(&ring, &folder, &fitted)).map_err(CommandError::other)?;

    recording.write(out, &ring)?;
    output::json(&out.join(MACHINE), &calibrated.machine)?;
    model_file::write(&out.join(MODEL), &ring.name, &model.tables)?;
    deliver(
        &options.common,
        &Written::of(out, &recording, &calibrated, &raw, mean_kick(&calibrated) * model.missing)
            .with_vars(&folder, &fitted),
    )
}

/// What the core's tables hold instead of the momentum.
fn held(ring: &Ring, rf: Rf) -> Result<Vec<Effect>, EffectError> {
    let frequency = (rf == Rf::FixedFrequency).then(|| Effect::at(EffectKind::FixedRfFrequency, "", 1.0, ring));
    frequency.into_iter().collect()
}

/// What a corrector kicks in a frame, on average [rad].
fn mean_kick(calibrated: &Calibrated) -> f64 {
    let kicks = calibrated.correctors.iter().map(|one| one.kick.abs() * MILLI / 2.0);
    kicks.sum::<f64>() / calibrated.correctors.len().max(1) as f64
}

/// The machine file of the recording.
pub const MACHINE: &str = "machine.json";
/// The core's tables of it.
pub const MODEL: &str = "model";

/// The matrix that the raw orbits make, and the orbits.
fn read(options: &Frames, rf: Rf) -> Result<(Folder, RawOrbits), CommandError> {
    let path = options.measurement.as_path();
    if !RawOrbits::are_in(path) {
        let problem = format!("{}: expected raw_orbit_minus_mm.csv and raw_orbit_plus_mm.csv", path.display());
        return Err(CommandError::Input(problem));
    }
    if let (Some(lattice), Some(monitors), Some(correctors)) = (&options.lattice, options.monitors, options.correctors)
    {
        let folder = Folder::read(lattice)?;
        let written = Model::of(&folder, &unknowns::groups(&folder), rf)?.as_written()?;
        return Ok(named(&RawOrbits::read(path)?, &folder, &written, [monitors, correctors])?);
    }
    if !Folder::is_one(path) {
        let problem = format!("{} holds raw orbits alone: --lattice says what they were read on", path.display());
        return Err(CommandError::Input(problem));
    }
    let folder = Folder::read(path)?;
    let raw = RawOrbits::of(path, &folder)?;
    Ok((Folder { matrix: raw.change.clone(), ..folder }, raw))
}

/// Strength factors as fitted, in the order of the ring's params.
fn vars(ring: &Ring, folder: &Folder, fitted: &Fit) -> Vec<f64> {
    let groups = fitted.groups[0].iter().map(|group| calibrated::param(folder, group));
    let fitted: Vec<(String, f64)> = groups.zip(fitted.values.iter().copied()).collect();
    let of = |name: &String| fitted.iter().find(|(own, _)| own == name).map_or(1.0, |(_, value)| *value);
    ring.parameters.iter().map(|one| of(&one.name)).collect()
}

/// Two frames a corrector, at minus and at plus half of its kick. Currents count positive where they kick to larger x or y.
fn recording(ring: &Ring, calibrated: &Calibrated, raw: &RawOrbits, rf: Rf) -> Result<Recording, CommandError> {
    let (change, middle) = (calibrated.orbits(&raw.change), calibrated.orbits(&raw.middle));
    // the ring has monitors and correctors of x first, each in beam order
    let row =
        |plane: Plane, label: &str| calibrated.monitors.iter().position(|one| one.plane == plane && one.label == label);
    let of_monitor = |b: usize| {
        let one = ring.monitors[ring.read_monitors[b]];
        row(one.plane, &ring.elements[one.element].label)
            .expect("the machine file has the monitors that are calibrated")
    };
    let rows: Vec<usize> = (0..ring.read_monitors.len()).map(of_monitor).collect();
    let mut place = vec![0; calibrated.correctors.len()];
    for (c, one) in calibrated.correctors.iter().enumerate() {
        place[c] = ring.corrector(one.plane, &one.label)?;
    }
    let mut kick_per_ampere = vec![1.0; ring.correctors.len()];
    let mut frames = Vec::new();
    for (one, &at) in calibrated.correctors.iter().zip(&place) {
        let amperes = raw.amperes[one.column].abs();
        kick_per_ampere[at] = one.kick.abs() * MILLI / amperes;
        for side in [-0.5, 0.5] {
            let setting = side * amperes * one.kick.signum();
            let orbit = |&b: &usize| middle[(b, one.column)] + side * change[(b, one.column)];
            let mut current = vec![0.0; ring.correctors.len()];
            current[at] = setting;
            frames.push(Row {
                sequence: frames.len() as u32 + 1,
                time: frames.len() as f64 + 1.0,
                cycle_time: 0.0,
                correctors: vec![(at, setting)],
                rf_offset: 0.0,
                dipole: None,
                supply: Vec::new(),
                other: Vec::new(),
                corrector_current: current,
                reading: rows.iter().map(orbit).map(|mm| mm.is_finite().then_some(mm * MILLI)).collect(),
                intensity: None,
                tune: [None; 2],
            });
        }
    }
    let header = Header {
        format: Format::Two,
        machine: ring.name.clone(),
        lattice: MACHINE.into(),
        recorded_with: "raw orbits of a measured response matrix, instruments as fitted to it".into(),
        particle: calibrated.machine["reference"]["particle"].as_str().unwrap_or_default().into(),
        kinetic_energy: calibrated.machine["reference"]["kinetic_energy_GeV"].as_f64().unwrap_or_default(),
        noise: rows.iter().map(|&b| calibrated.monitors[b].sigma * MILLI).collect(),
        kick_per_ampere,
        kick_convention: "each corrector at minus, then at plus half of its kick".into(),
        believed_rf: match rf {
            Rf::FixedFrequency => BelievedRf::FixedFrequency,
            Rf::FixedMomentum => BelievedRf::FixedMomentum,
        },
        nominal_dipole: None,
        nominal: Vec::new(),
        transfer: Vec::new(),
        dipole_transfer: Vec::new(),
        radial_loop_monitors: None,
        note: "frames a second apart, as their times were not written down".into(),
        ramp: Ramp::default(),
    };
    Ok(Recording { name: ring.name.clone(), header, other: Vec::new(), rows: frames })
}
