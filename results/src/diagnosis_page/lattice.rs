//! The lattice as figures show it.

use diagnosis::{Diagnosis, Finding};
use report::{Look, Magnet, Spotted, Strip, Symbol};
use twin::{Class, Kind, Ring};

/// Magnets and instruments; a place of monitors of which none is read is one that is not read.
pub fn magnets(ring: &Ring) -> Vec<Magnet> {
    let read: Vec<usize> = ring.monitors_read().map(|monitor| monitor.element).collect();
    let symbol = |at: usize, kind: &Kind| match kind {
        Kind::Bend(_) => Some(Symbol::Bend),
        Kind::Quadrupole { k1 } if *k1 > 0.0 => Some(Symbol::Focusing),
        Kind::Quadrupole { .. } => Some(Symbol::Defocusing),
        Kind::Sextupole { .. } => Some(Symbol::Sextupole),
        Kind::Monitor if read.contains(&at) => Some(Symbol::Monitor),
        Kind::Monitor => Some(Symbol::UnreadMonitor),
        Kind::Corrector { .. } => Some(Symbol::Corrector),
        _ => None,
    };
    let of = |(at, element): (usize, &twin::Element)| {
        Some(Magnet { symbol: symbol(at, &element.kind)?, s: element.s, length: element.length })
    };
    ring.elements.iter().enumerate().filter_map(of).collect()
}

/// The strip below a figure along the beam, with the places of all findings.
pub fn strip(diagnosis: &Diagnosis) -> Strip {
    let ring = &diagnosis.found.data.ring;
    let marks = diagnosis.findings.iter().flat_map(|finding| {
        let spotted = |s: f64| Spotted { label: finding.at.clone(), s, look: Look::Finding };
        positions(ring, finding).into_iter().map(spotted)
    });
    Strip { marks: marks.collect(), magnets: magnets(ring) }
}

/// Positions of a finding: two for exchanged monitors, none for an effect on the whole ring.
pub fn positions(ring: &Ring, finding: &Finding) -> Vec<f64> {
    let Some(term) = finding.term() else { return finding.s.into_iter().collect() };
    match term.kind.class() {
        Class::Monitor(_) | Class::Corrector(_) | Class::Field(_) => term.site.positions(ring),
        Class::Hold(_) | Class::Drift(_) => Vec::new(),
    }
}

/// What the strip shows, for a caption.
pub const STRIP: &str = "Below: the lattice, to scale in s.";
