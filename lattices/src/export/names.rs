//! Names that every format takes: letters, digits, `_` and `.`, a letter first, unique whatever the case.

use std::collections::HashSet;

/// Longest name: Bmad takes 40 characters, of which a knob adds up to seven.
const LONGEST: usize = 32;

/// Words that MAD-X or Bmad keep for themselves, and the name of the sequence or line.
const RESERVED: &str = "ring \
    assign beam beta0 call const coguess constraint create delete dumpsequ ealign efcomp emit endedit endmatch endsequence \
    exec exit false fill global help if macro makethin match option plot print quit readtable real resplot return save \
    select set seqedit sequence setplot show sodd stop survey system title touschek track true twiss use value vary weight \
    while write \
    ab_multipole ac_kicker beambeam beginning calc_reference_orbit collimator combine_consecutive_elements crab_cavity \
    crabcavity custom debug_marker dipedge drift ecollimator elseparator end_file expand_lattice fiducial floor_shift foil \
    fork girder group hkicker hmonitor instrument kicker lcavity line marker mask match matrix merge_elements monitor \
    multipole no_digested no_superimpose nllens null_ele octupole overlay parameter parser_debug particle_start patch pipe \
    placeholder quadrupole ramper rbend rcollimator redef remove_elements rf_bend rfcavity rfmultipole root sad_mult sample \
    sbend setenv sextupole slice_lattice sol_quad solenoid srotation start_branch_at superimpose taylor thick_multipole \
    tkicker translation undulator use_local_lat_file vkicker vmonitor wiggler write_digested xrotation yrotation";

/// Names given out so far.
#[derive(Debug)]
pub(super) struct Names {
    taken: HashSet<String>,
}

impl Names {
    /// None but the reserved words.
    pub fn new() -> Self {
        Self { taken: RESERVED.split_whitespace().map(str::to_owned).collect() }
    }

    /// The wanted name, or the nearest one that is allowed and free.
    pub fn take(&mut self, wanted: &str) -> String {
        let allowed = |c: char| if c.is_ascii_alphanumeric() || "_.".contains(c) { c } else { '_' };
        let mut name: String = wanted.chars().map(allowed).collect();
        if !name.starts_with(|c: char| c.is_ascii_alphabetic()) {
            name.insert_str(0, "e_");
        }
        name.truncate(LONGEST);
        let free = (1..).map(|n| if n == 1 { name.clone() } else { numbered(&name, n) });
        let mut free = free.filter(|name| self.taken.insert(name.to_ascii_lowercase()));
        free.next().expect("there are more numbers than names")
    }
}

/// `Q_2`, shortened in front of the number if need be.
fn numbered(name: &str, n: usize) -> String {
    let number = format!("_{n}");
    format!("{}{number}", &name[..name.len().min(LONGEST - number.len())])
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn good_names_stay_and_others_become_good() {
        let mut names = Names::new();
        let wanted = ["QH_A2", "MQ.12R1", "01F", "Q 1/a", "ß", "qh_a2", "Drift", "QH_A2"];
        let given = ["QH_A2", "MQ.12R1", "e_01F", "Q_1_a", "e__", "qh_a2_2", "Drift_2", "QH_A2_3"];
        assert_eq!(wanted.map(|name| names.take(name)), given);
    }

    #[test]
    fn long_names_are_cut_and_stay_apart() {
        let mut names = Names::new();
        let long = "A".repeat(50);
        let (one, two) = (names.take(&long), names.take(&long));
        assert_eq!((one.len(), two.len()), (32, 32));
        assert!(one != two && two.ends_with("_2"));
    }
}
