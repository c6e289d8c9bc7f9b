//! A MAD-X sequence: one knob for each corrector, gains and rolls of correctors in its expression.
//!
//! Source: MAD-X user's guide, chapters on element types, SEQUENCE and EALIGN; signs as `docs/model.md` sets them.

use core::fmt::Write;

use twin::{Element, Kind, Misalignment, Plane};

use super::attributes::Attributes;
use super::lattice::{Channel, Lattice};

/// The file.
pub(super) fn text(lattice: &Lattice) -> String {
    let energy = lattice.particle.rest_energy + lattice.particle.kinetic_energy;
    let mut text = comments(lattice);
    let _ = writeln!(text, "\nbeam, particle = {}, energy = {energy:?};\n", lattice.particle.name());
    for channel in &lattice.correctors {
        let _ = writeln!(text, "{} = 0;", channel.knob);
    }
    let _ = writeln!(text);
    let placed = || lattice.elements.iter().enumerate().filter(|(_, e)| e.kind != Kind::Drift);
    for (at, element) in placed() {
        let _ = writeln!(text, "{}: {};", element.name, definition(lattice, at, element));
    }
    let _ = writeln!(text, "\nring: sequence, l = {:?}, refer = entry;", lattice.circumference);
    for (_, element) in placed() {
        let _ = writeln!(text, "  {}, at = {:?};", element.name, element.s);
    }
    let _ = writeln!(text, "endsequence;\n\nuse, sequence = ring;");
    alignment(lattice, &mut text);
    text
}

fn comments(lattice: &Lattice) -> String {
    let rolled = lattice.monitors.iter().filter(|channel| channel.roll != 0.0);
    lattice.remarks_of("MAD-X", rolled).iter().map(|remark| format!("! {remark}\n")).collect()
}

/// Class and attributes.
fn definition(lattice: &Lattice, at: usize, element: &Element) -> String {
    let mut attributes = Attributes::new();
    let class = match &element.kind {
        Kind::Drift => unreachable!("a sequence has no drifts"),
        Kind::Marker => "marker",
        Kind::Monitor => monitor(lattice, at),
        Kind::Corrector { .. } => return corrector(lattice, at),
        Kind::Quadrupole { k1 } => {
            attributes.length(element).number("k1", *k1);
            "quadrupole"
        }
        Kind::Sextupole { k2 } => {
            attributes.length(element).number("k2", *k2);
            "sextupole"
        }
        Kind::Solenoid { ks } => {
            attributes.length(element).number("ks", *ks);
            "solenoid"
        }
        Kind::Multipole { k1l, k1sl, k2l, k3l } => {
            attributes.list("knl", &[0.0, *k1l, *k2l, *k3l]).list("ksl", &[0.0, *k1sl]);
            "multipole"
        }
        Kind::Wiggler { focusing } => {
            attributes.length(element).number("rm43", -focusing);
            "matrix"
        }
        Kind::Bend(bend) => {
            attributes.length(element).number("angle", bend.curvature * element.length);
            attributes.other("k1", bend.k1).other("k2", bend.k2).other("e1", bend.e1).other("e2", bend.e2);
            if bend.fringe != 0.0 {
                attributes.number("fint", 0.5).number("hgap", bend.fringe);
            }
            "sbend"
        }
    };
    attributes.other("tilt", element.misalignment.roll);
    format!("{class}{}", attributes)
}

fn monitor(lattice: &Lattice, at: usize) -> &'static str {
    let planes: Vec<Plane> = Lattice::channels_of(&lattice.monitors, at).map(|channel| channel.plane).collect();
    match planes[..] {
        [Plane::X] => "hmonitor",
        [Plane::Y] => "vmonitor",
        _ => "monitor",
    }
}

fn corrector(lattice: &Lattice, at: usize) -> String {
    let channels: Vec<&Channel> = Lattice::channels_of(&lattice.correctors, at).collect();
    match channels[..] {
        [one] if one.roll == 0.0 => {
            let class = if one.plane == Plane::X { "hkicker" } else { "vkicker" };
            format!("{class}, kick := {}", term(one.gain, &one.knob))
        }
        _ => {
            let sum = |plane: usize| {
                let terms = channels.iter().filter(|channel| channel.axis()[plane] != 0.0);
                terms.map(|channel| term(channel.axis()[plane], &channel.knob)).collect::<Vec<_>>().join(" + ")
            };
            format!("kicker, hkick := {}, vkick := {}", sum(0), sum(1))
        }
    }
}

/// A knob times its factor.
fn term(factor: f64, knob: &str) -> String {
    if factor == 1.0 { knob.into() } else { format!("({factor:?}) * {knob}") }
}

/// Shifts of elements and gains of monitors, which are errors of the sequence in use.
fn alignment(lattice: &Lattice, text: &mut String) {
    for (at, element) in lattice.elements.iter().enumerate() {
        let mut attributes = Attributes::new();
        let Misalignment { dx, dy, .. } = element.misalignment;
        attributes.other("dx", dx).other("dy", dy);
        for channel in Lattice::channels_of(&lattice.monitors, at) {
            let word = if channel.plane == Plane::X { "mscalx" } else { "mscaly" };
            attributes.other(word, channel.gain - 1.0);
        }
        if !attributes.is_empty() {
            let _ = writeln!(text, "select, flag = error, clear;\nselect, flag = error, range = {};", element.name);
            let _ = writeln!(text, "ealign{};", attributes);
        }
    }
}
