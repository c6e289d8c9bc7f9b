//! Where an effect acts: a place of a ring, read from its name once.

use crate::lattice::{Kind, Plane, Ring};

/// A place of a ring, by index into its lists. Names are those of the command line: monitors with their plane (`x_D8`), correctors
/// likewise (`H_A4`), quadrupoles by label (`D8`), other elements by name.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Site {
    /// The whole ring.
    Ring,
    /// One plane of a monitor, into [`Ring::monitors`].
    Monitor(usize),
    /// Two of them, the lower index first.
    MonitorPair(usize, usize),
    /// One plane of a corrector, into [`Ring::correctors`].
    Corrector(usize),
    /// Two of them, the lower index first.
    CorrectorPair(usize, usize),
    /// Into [`Ring::quadrupoles`].
    Quadrupole(usize),
    /// Any other element, into [`Ring::elements`].
    Element(usize),
}

impl Site {
    /// True of two instruments.
    pub fn is_pair(self) -> bool {
        matches!(self, Self::MonitorPair(..) | Self::CorrectorPair(..))
    }

    /// Two monitors in either order.
    pub fn pair(one: usize, other: usize) -> Self {
        Self::MonitorPair(one.min(other), one.max(other))
    }

    /// Two correctors in either order.
    pub fn corrector_pair(one: usize, other: usize) -> Self {
        Self::CorrectorPair(one.min(other), one.max(other))
    }

    /// The monitor of a name with its plane, `x_D8` or `x_PUH_D8`.
    pub fn monitor(ring: &Ring, name: &str) -> Option<usize> {
        planed(name, ["x", "y"]).and_then(|(plane, name)| ring.monitor(plane, name).ok())
    }

    /// The two different monitors of a name, `x_D8,x_E6`.
    pub fn monitors(ring: &Ring, names: &str) -> Option<[usize; 2]> {
        two(names, |name| Self::monitor(ring, name))
    }

    /// The corrector of a name with its plane, `H_A4` or `H_DCH_A4`.
    pub fn corrector(ring: &Ring, name: &str) -> Option<usize> {
        planed(name, ["H", "V"]).and_then(|(plane, name)| ring.corrector(plane, name).ok())
    }

    /// The two different correctors of a name, `H_A4,H_A6`.
    pub fn correctors(ring: &Ring, names: &str) -> Option<[usize; 2]> {
        two(names, |name| Self::corrector(ring, name))
    }

    /// The element of some sort that is called so, by its label or its name.
    pub fn element(ring: &Ring, name: &str, is: impl Fn(&Kind) -> bool) -> Option<usize> {
        ring.elements.iter().position(|element| is(&element.kind) && element.is_called(name))
    }

    /// The name, empty for the whole ring; of a pair `x_D8,x_E6`.
    pub fn name(self, ring: &Ring) -> String {
        self.names(ring).join(",")
    }

    /// The names: none of the whole ring, two of a pair. Sextupoles, of which a cell has one of either family, are named by their
    /// label, `SX_A1`.
    pub fn names(self, ring: &Ring) -> Vec<String> {
        match self {
            Self::Ring => Vec::new(),
            Self::Monitor(at) => vec![ring.monitor_name(at)],
            Self::MonitorPair(one, other) => [one, other].map(|at| ring.monitor_name(at)).into(),
            Self::Corrector(at) => vec![ring.corrector_name(at)],
            Self::CorrectorPair(one, other) => [one, other].map(|at| ring.corrector_name(at)).into(),
            Self::Quadrupole(at) => vec![ring.label(ring.quadrupoles[at].element).to_owned()],
            Self::Element(at) => {
                let element = &ring.elements[at];
                let is_short = matches!(element.kind, Kind::Sextupole { .. }) && element.label != element.name;
                vec![if is_short { format!("SX_{}", element.label) } else { element.name.clone() }]
            }
        }
    }

    /// The elements that it is about: none of the whole ring, two of a pair.
    pub fn elements(self, ring: &Ring) -> Vec<usize> {
        match self {
            Self::Ring => Vec::new(),
            Self::Monitor(at) => vec![ring.monitors[at].element],
            Self::MonitorPair(one, other) => [one, other].map(|at| ring.monitors[at].element).into(),
            Self::Corrector(at) => vec![ring.correctors[at].element],
            Self::CorrectorPair(one, other) => [one, other].map(|at| ring.correctors[at].element).into(),
            Self::Quadrupole(at) => vec![ring.quadrupoles[at].element],
            Self::Element(at) => vec![at],
        }
    }

    /// The middles of these elements along the beam [m].
    pub fn positions(self, ring: &Ring) -> Vec<f64> {
        let middle = |at: usize| ring.elements[at].s + 0.5 * ring.elements[at].length;
        self.elements(ring).into_iter().map(middle).collect()
    }
}

/// Two different places of a name, `one,other`.
fn two(names: &str, find: impl Fn(&str) -> Option<usize>) -> Option<[usize; 2]> {
    let (one, other) = names.split_once(',')?;
    let [one, other] = [one, other].map(|name| find(name.trim()));
    Some([one?, other?]).filter(|[one, other]| one != other)
}

/// Plane and rest of a name that begins with one of two words for the planes.
fn planed<'n>(name: &'n str, [x, y]: [&str; 2]) -> Option<(Plane, &'n str)> {
    let (word, rest) = name.split_once('_')?;
    [(x, Plane::X), (y, Plane::Y)].into_iter().find(|(known, _)| *known == word).map(|(_, plane)| (plane, rest))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_lead_to_their_places_and_back() {
        let ring = Ring::booster();
        for at in 0..48 {
            assert_eq!(Site::monitor(&ring, &Site::Monitor(at).name(&ring)), Some(at));
            assert_eq!(Site::corrector(&ring, &Site::Corrector(at).name(&ring)), Some(at));
            assert_eq!(ring.quadrupole(&Site::Quadrupole(at).name(&ring)).unwrap(), at);
        }
        let of = |name| Site::monitor(&ring, name).unwrap();
        assert_eq!((of("x_D8"), of("y_C5")), (of("x_PUH_D8"), of("y_PUV_C5")));
        assert_eq!(Site::monitors(&ring, "x_E6, x_E4"), Some([of("x_E6"), of("x_E4")]));
        assert_eq!(Site::pair(of("x_E6"), of("x_E4")).name(&ring), "x_E4,x_E6");
        let of = |name| Site::corrector(&ring, name).unwrap();
        assert_eq!(Site::correctors(&ring, "H_A6,H_A4"), Some([of("H_A6"), of("H_A4")]));
        assert_eq!(Site::corrector_pair(of("H_A6"), of("H_A4")).name(&ring), "H_A4,H_A6");
        let dipole = Site::element(&ring, "C4", |kind| matches!(kind, Kind::Bend(_))).unwrap();
        assert_eq!(Site::Element(dipole).name(&ring), "B_C4");
    }

    #[test]
    fn what_names_no_place_is_none() {
        let ring = Ring::booster();
        assert!(["x_C5", "C5", "z_D8", "H_A4", ""].iter().all(|name| Site::monitor(&ring, name).is_none()));
        assert!(["x_E4", "x_E4,", "x_E4,x_E4", "x_E4,x_E99"].iter().all(|name| Site::monitors(&ring, name).is_none()));
    }

    #[test]
    fn a_place_stands_where_its_elements_are() {
        let ring = Ring::booster();
        let pair = Site::pair(Site::monitor(&ring, "x_E4").unwrap(), Site::monitor(&ring, "x_E6").unwrap());
        assert_eq!((Site::Ring.positions(&ring).len(), pair.positions(&ring).len()), (0, 2));
        let magnet = &ring.elements[ring.element("QH_D8").unwrap()];
        let at = Site::Quadrupole(ring.quadrupole("D8").unwrap()).positions(&ring)[0];
        assert_eq!(at, magnet.s + 0.5 * magnet.length);
    }
}
