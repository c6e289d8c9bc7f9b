//! A Bmad lattice: gains and rolls of monitors in their own attributes, those of correctors in overlays.
//!
//! Source: D. Sagan, The Bmad Reference Manual, chapters on lattice files, elements, electromagnetic fields and
//! instrumental measurements; signs as `docs/model.md` sets them. Bmad's defaults are the twin's maps: `bmad_standard`
//! tracking, bends with `basic_bend` fringes, no fringes of quadrupoles.

use core::fmt::Write;

use twin::{Element, Kind, Plane};

use super::attributes::Attributes;
use super::lattice::{Channel, Lattice};

/// Characters of a line of the file; Bmad takes 500.
const WIDTH: usize = 100;

/// The file.
pub(super) fn text(lattice: &Lattice) -> String {
    let energy = (lattice.particle.rest_energy + lattice.particle.kinetic_energy) * 1e9;
    let mut text = String::new();
    for remark in &lattice.remarks {
        let _ = writeln!(text, "! {remark}");
    }
    let _ = writeln!(text, "\nparameter[geometry] = closed");
    let _ = writeln!(text, "parameter[particle] = {}\nparameter[e_tot] = {energy:?}\n", lattice.particle.name());
    for (at, element) in lattice.elements.iter().enumerate() {
        let _ = writeln!(text, "{}: {}", element.name, definition(lattice, at, element));
    }
    let _ = writeln!(text);
    for (at, element) in lattice.elements.iter().enumerate() {
        text += &overlays(lattice, at, element);
    }
    let _ =
        writeln!(text, "\nring: line = (\n{})\n\nuse, ring", wrapped(lattice.elements.iter().map(|e| e.name.as_str())));
    text
}

/// Names with commas, in lines that end with one.
fn wrapped<'n>(names: impl Iterator<Item = &'n str>) -> String {
    let (mut text, mut width) = (String::new(), 0);
    for name in names {
        let separator = match width {
            0 if text.is_empty() => "  ",
            _ if width + name.len() > WIDTH => ",\n  ",
            _ => ", ",
        };
        width = if separator == ", " { width } else { 0 } + separator.len() + name.len();
        text += separator;
        text += name;
    }
    text
}

/// Class and attributes.
fn definition(lattice: &Lattice, at: usize, element: &Element) -> String {
    let mut attributes = Attributes::new();
    let class = match &element.kind {
        Kind::Drift => {
            attributes.length(element);
            "drift"
        }
        Kind::Marker => "marker",
        Kind::Monitor => {
            Lattice::channels_of(&lattice.monitors, at).for_each(|channel| instrument(channel, &mut attributes));
            "monitor"
        }
        Kind::Corrector { .. } => corrector(lattice, at),
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
        Kind::Wiggler { focusing } => {
            attributes.length(element).other("tt43", -focusing);
            "taylor"
        }
        // b_n + i a_n is the integrated field over n!
        Kind::Multipole { k1l, k1sl, k2l, k3l } => {
            attributes.other("b1", *k1l).other("a1", *k1sl).other("b2", k2l / 2.0).other("b3", k3l / 6.0);
            "ab_multipole"
        }
        Kind::Bend(bend) => {
            attributes.length(element).number("g", bend.curvature);
            attributes.other("k1", bend.k1).other("k2", bend.k2).other("e1", bend.e1).other("e2", bend.e2);
            if bend.fringe != 0.0 {
                attributes.number("fint", 0.5).number("hgap", bend.fringe);
            }
            "sbend"
        }
    };
    let roll = if matches!(element.kind, Kind::Bend(_)) { "ref_tilt" } else { "tilt" };
    let misalignment = element.misalignment;
    attributes.other(roll, misalignment.roll);
    attributes.other("x_offset", misalignment.dx).other("y_offset", misalignment.dy);
    format!("{class}{attributes}")
}

/// Gain and roll of one plane of a monitor; Bmad turns both planes together.
fn instrument(channel: &Channel, attributes: &mut Attributes) {
    let word = if channel.plane == Plane::X { "x_gain_err" } else { "y_gain_err" };
    attributes.other(word, channel.gain - 1.0).other("tilt", channel.roll);
}

fn corrector(lattice: &Lattice, at: usize) -> &'static str {
    let planes: Vec<Plane> = Lattice::channels_of(&lattice.correctors, at)
        .filter(|channel| channel.roll == 0.0)
        .map(|channel| channel.plane)
        .collect();
    match planes[..] {
        [Plane::X] => "hkicker",
        [Plane::Y] => "vkicker",
        _ => "kicker",
    }
}

/// An overlay for each plane of a corrector that is not ideal.
fn overlays(lattice: &Lattice, at: usize, element: &Element) -> String {
    let class = corrector(lattice, at);
    let one = |channel: &Channel| {
        let [x, y] = channel.axis();
        let targets = match class {
            "kicker" => [("hkick", x), ("vkick", y)].to_vec(),
            "hkicker" => vec![("kick", x)],
            _ => vec![("kick", y)],
        };
        let targets: Vec<String> = (targets.iter().filter(|(_, factor)| *factor != 0.0))
            .map(|(word, factor)| format!("{}[{word}]: ({factor:?}) * setting", element.name))
            .collect();
        format!("{}: overlay = {{{}}}, var = {{setting}}\n", channel.knob, targets.join(", "))
    };
    Lattice::channels_of(&lattice.correctors, at).filter(|channel| !channel.is_ideal()).map(one).collect()
}
