//! Short names of elements: stated ones, and what follows the first `_` of a name where that is unique.
//!
//! Whoever looks for an element may use its label or its name, so within a sort no label is another element's label or
//! name. Monitors and correctors of different planes are of different sorts: `PUH_A1` and `PUV_A1` are both `A1`.

use std::collections::HashMap;

use super::{LatticeError, Plane};

/// The type of an element, and for monitors and correctors one of their planes.
pub(super) type Sort<'f> = (&'f str, Option<Plane>);

/// An element as far as its label is concerned.
#[derive(Debug)]
pub(super) struct Named<'f> {
    pub name: &'f str,
    /// The label that the file states.
    pub stated: Option<&'f str>,
    /// One, or two of an element for both planes.
    pub sorts: Vec<Sort<'f>>,
}

/// Who claims a word within a sort, by index.
type Claims<'f> = HashMap<(Sort<'f>, &'f str), Vec<usize>>;

impl<'f> Named<'f> {
    /// What follows the first `_` of the name.
    fn short(&self) -> Option<&'f str> {
        self.name.split_once('_').map(|(_, short)| short).filter(|short| !short.is_empty())
    }

    /// Another element that claims a word in one of this element's sorts.
    fn other(&self, own: usize, word: &'f str, claims: &Claims<'f>) -> Option<usize> {
        let of_sort = |sort: &Sort<'f>| claims.get(&(*sort, word))?.iter().copied().find(|&i| i != own);
        self.sorts.iter().find_map(of_sort)
    }
}

/// The label of each element.
///
/// # Errors
/// [`LatticeError::Label`] where a stated one is taken.
pub(super) fn labels(elements: &[Named]) -> Result<Vec<String>, LatticeError> {
    let certain = claims(elements, |e| [Some(e.name), e.stated]);
    let short = claims(elements, |e| [e.short().filter(|_| e.stated.is_none()), None]);
    let label = |(i, e): (usize, &Named)| {
        if let Some(label) = e.stated {
            return match e.other(i, label, &certain) {
                None => Ok(label.to_owned()),
                Some(other) => {
                    let other = elements[other].name.into();
                    Err(LatticeError::Label { name: e.name.into(), label: label.into(), other })
                }
            };
        }
        let free = |word: &&str| e.other(i, word, &certain).or_else(|| e.other(i, word, &short)).is_none();
        Ok(e.short().filter(free).unwrap_or(e.name).to_owned())
    };
    elements.iter().enumerate().map(label).collect()
}

fn claims<'f>(elements: &[Named<'f>], words: impl Fn(&Named<'f>) -> [Option<&'f str>; 2]) -> Claims<'f> {
    let mut claims = Claims::new();
    for (i, element) in elements.iter().enumerate() {
        for word in words(element).into_iter().flatten() {
            element.sorts.iter().for_each(|&sort| claims.entry((sort, word)).or_default().push(i));
        }
    }
    claims
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of<'f>(names: &[(&'f str, Option<&'f str>)]) -> Result<Vec<String>, LatticeError> {
        let named = |&(name, stated)| Named { name, stated, sorts: vec![("quadrupole", None)] };
        labels(&names.iter().map(named).collect::<Vec<_>>())
    }

    #[test]
    fn a_label_is_what_follows_the_first_underscore_where_that_is_unique() {
        let names = ["QH_A2", "QH_B2", "QT_B2", "Q", "Q_", "_C3", "ß_Δ_1"];
        let known = ["A2", "QH_B2", "QT_B2", "Q", "Q_", "C3", "Δ_1"];
        assert_eq!(of(&names.map(|name| (name, None))).unwrap(), known);
    }

    #[test]
    fn names_and_stated_labels_come_before_default_ones() {
        assert_eq!(of(&[("Q_A", None), ("A", None)]).unwrap(), ["Q_A", "A"]);
        assert_eq!(of(&[("Q_A", None), ("P", Some("A"))]).unwrap(), ["Q_A", "A"]);
        // the whole names of the first two, although the third would be short for one of them
        assert_eq!(of(&[("A_B", None), ("C_B", None), ("Z_A_B", None)]).unwrap(), ["A_B", "C_B", "Z_A_B"]);
    }

    #[test]
    fn a_stated_label_that_is_taken_is_refused() {
        let message = |names: &[_]| of(names).unwrap_err().to_string();
        assert_eq!(message(&[("P", Some("A")), ("Q", Some("A"))]), r#"element P: label "A" is taken by element Q"#);
        assert_eq!(message(&[("A", Some("B")), ("Q", Some("A"))]), r#"element Q: label "A" is taken by element A"#);
    }

    #[test]
    fn an_element_of_both_planes_shares_its_label_with_neither() {
        let sorts = |planes: &[Plane]| planes.iter().map(|&plane| ("bpm", Some(plane))).collect();
        let named = |name, planes| Named { name, stated: None, sorts: sorts(planes) };
        let elements = [
            named("X_1", &[Plane::X]),
            named("Y_1", &[Plane::Y]),
            named("X_2", &[Plane::X]),
            named("XY_2", &[Plane::X, Plane::Y]),
        ];
        assert_eq!(labels(&elements).unwrap(), ["1", "1", "X_2", "XY_2"]);
    }
}
