//! Rings of cells of any size, and campaigns of them.

use core::fmt::Write as _;
use std::path::Path;

use inference::Recording;
use inference::simulate::{self, Hardware, Truth};
use serde_json::{Value, json};
use twin::Ring;

/// Length of a cell [m].
const CELL: f64 = 9.0;
/// Gradients [1/m^2]: a cell has a betatron phase of 0.28 and 0.26 turns.
const K1: [f64; 2] = [0.86, -0.84];
/// Width of the vars' prior: errors of hundreds of quadrupoles add up.
const WIDTH: f64 = 0.003;
/// A corrector's current when it is set [A], and its kick a unit of it [mrad/A].
const CURRENT: f64 = 1.0;
const KICK: f64 = 0.02;
/// Noise of a reading [mm].
const NOISE: f64 = 0.005;

/// The machine file of FODO cells, each with two quadrupoles, a corrector of each plane, and a monitor that reads both; the first `further` have another
/// monitor.
///
/// # Panics
/// If there are more further monitors than cells.
pub fn file(cells: usize, further: usize) -> Value {
    assert!(further <= cells, "a cell has two monitors at most");
    let cell = |number: usize| cell(number, core::f64::consts::PI / cells as f64, number < further);
    let elements: Vec<Value> = (0..cells).flat_map(cell).collect();
    json!({
        "name": format!("{cells} cells"),
        "circumference_m": CELL * cells as f64,
        "k1": {"QF": K1[0], "QD": K1[1]},
        "reference": {"particle": "electron", "kinetic_energy_GeV": 6.0},
        "data": {"prior_width": WIDTH},
        "elements": elements,
    })
}

/// The elements of one cell, whose dipoles bend by some angle each.
fn cell(number: usize, angle: f64, has_both_monitors: bool) -> impl Iterator<Item = Value> {
    let bend = json!({"type": "sbend", "length": 2.0, "angle": angle, "e1": 0.5 * angle, "e2": 0.5 * angle});
    let quadrupole = |family: &str| json!({"type": "quadrupole", "length": 0.4, "family": family});
    let corrector = |plane: &str| json!({"type": "corrector", "length": 0.0, "plane": plane});
    let monitor = |plane: &str| json!({"type": "bpm", "length": 0.0, "plane": plane});
    let elements = [
        ("CH", "F", 0.3, corrector("H")),
        ("BX", "F", 0.5, monitor("H")),
        ("BY", "F", 0.5, monitor("V")),
        ("QF", "F", 0.6, quadrupole("QF")),
        ("B", "F", 1.5, bend.clone()),
        ("CV", "D", 4.3, corrector("V")),
        ("BX", "D", 4.5, monitor("H")),
        ("BY", "D", 4.5, monitor("V")),
        ("QD", "D", 4.6, quadrupole("QD")),
        ("B", "D", 5.5, bend),
    ];
    let is_there = move |(name, half, ..): &(&str, &str, f64, Value)| {
        has_both_monitors || *half == "F" || !["BX", "BY"].contains(name)
    };
    elements.into_iter().filter(is_there).map(move |(name, half, at, mut element)| {
        element["name"] = json!(format!("{name}_{number:03}{half}"));
        element["s_start"] = json!(CELL * number as f64 + at);
        element
    })
}

/// The same as a ring.
///
/// # Panics
/// As [`file`].
pub fn ring(cells: usize, further: usize) -> Ring {
    Ring::parse(&file(cells, further).to_string(), "ring.json").expect("a ring")
}

/// A campaign of a ring as its errors make it, of so many frames: no corrector, then each up and down, in turn.
///
/// # Panics
/// If the ring with its errors is not stable.
pub fn campaign(ring: &Ring, frames: usize, vars: &[f64]) -> Recording {
    let template = template(ring, frames);
    let noise = template.header.noise.clone();
    let hardware = Hardware { misalignment: [5e-6; 2], offset: 1e-4, noise, jumps: Vec::new(), tune_noise: 1e-4 };
    let truth = Truth { vars, ..Truth::default() };
    simulate::campaign(&template, ring, &truth, &hardware, 1).expect("a stable ring")
}

/// The campaign's settings, without readings.
fn template(ring: &Ring, frames: usize) -> Recording {
    let header = format!(
        "machine = \"{}\"\nlattice = \"ring.json\"\nrecorded_with = \"simulated\"\nparticle = \"electron\"\n\
         kinetic_energy_GeV = 6.0\nbpm_sigma_mm = {NOISE}\nkick_mrad_per_A = {KICK}\n\
         kick_convention = \"one setting a frame\"\nbelieved_rf = \"fixed_momentum\"\n\
         nominal_A = {{ dipole = 100.0, qh = 100.0, qv = 100.0 }}\nquad_transfer = [0.0, 1.0]\n",
        ring.name
    );
    let (correctors, monitors) = (ring.corrector_names(), ring.monitor_names());
    let mut text =
        String::from("seq,time_s,t_cycle_ms,corrector,setting_A,drf_rel,i_dipole_A,i_qh_A,i_qv_A,i_sh_A,i_sv_A");
    correctors.iter().for_each(|name| _ = write!(text, ",ic_{name}_A"));
    monitors.iter().for_each(|name| _ = write!(text, ",{name}_mm"));
    text.push_str(",qx_frac,qy_frac\n");
    let settings = core::iter::once((0, 0.0)).chain((0..correctors.len()).flat_map(|c| [(c, CURRENT), (c, -CURRENT)]));
    for (frame, (set, current)) in settings.cycle().take(frames).enumerate() {
        let _ = write!(text, "{frame},{},0,{},{current},0,100,100,100,0,0", 0.1 * frame as f64, correctors[set]);
        (0..correctors.len()).for_each(|c| _ = write!(text, ",{}", if c == set { current } else { 0.0 }));
        monitors.iter().for_each(|_| text.push_str(",0"));
        text.push_str(",0.3,0.3\n");
    }
    Recording::parse(Path::new("cells"), ring, &header, &text).expect("a recording of the ring")
}
