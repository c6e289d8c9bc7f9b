//! `[feedback]`: what is wanted of the orbit, and which correctors may be moved for it.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use inference::stream;
use serde::Deserialize;
use twin::Ring;
use twin::limits::{self, FILE};

/// `[feedback]`
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields, default)]
#[allow(non_snake_case)] // units
pub struct Feedback {
    /// Set points are computed and published.
    pub on: bool,
    /// Correctors that it moves; none named, and it is all of them.
    correctors: Option<Vec<String>>,
    /// Wanted readings; none, and they are 0.
    pub orbit_file: Option<PathBuf>,
    limit_A: f32,
    rate_A: f32,
    probe_A: f32,
    close_A: f32,
    step_mrad: f32,
    total_mrad: f32,
    walk_um_per_root_second: f32,
    patience_ms: u64,
}

/// What `docs/feedback.md` recommends for the Booster.
impl Default for Feedback {
    fn default() -> Self {
        Self {
            on: false,
            correctors: None,
            orbit_file: None,
            limit_A: 20.0,
            rate_A: 2.0,
            probe_A: 1.0,
            close_A: 0.3,
            step_mrad: 0.02,
            total_mrad: 1.0,
            walk_um_per_root_second: 5.0,
            patience_ms: 2_000,
        }
    }
}

impl Feedback {
    /// By the names of a ring.
    ///
    /// # Errors
    /// What is wrong with names or the file, all of it.
    pub fn of(&self, ring: &Ring) -> Result<stream::Feedback, String> {
        let (all, monitors) = (ring.corrector_names(), ring.monitor_names());
        let used = self.correctors.as_ref().unwrap_or(&all);
        let unknown = used.iter().filter(|name| !all.contains(name));
        let mut wrong: Vec<String> =
            unknown.map(|name| format!("feedback.correctors: {} has no {name:?}", ring.name)).collect();
        let wanted = self.orbit_file.as_deref().map_or_else(|| Ok(BTreeMap::new()), orbit)?;
        let strange = wanted.keys().filter(|name| !monitors.contains(name));
        wrong.extend(strange.map(|name| format!("feedback.orbit_file: {} has no monitor {name:?}", ring.name)));
        if !wrong.is_empty() {
            return Err(wrong.join("; "));
        }
        let limit = |name: &String| if used.contains(name) { self.limit_A } else { 0.0 };
        Ok(stream::Feedback {
            orbit: monitors.iter().map(|name| wanted.get(name).copied().unwrap_or(0.0) * 1e-3).collect(),
            limit: all.iter().map(limit).collect(),
            walk: self.walk_um_per_root_second * 1e-6,
            step_kick: self.step_mrad * 1e-3,
            total_kick: self.total_mrad * 1e-3,
            rate: self.rate_A,
            probe: self.probe_A,
            close: self.close_A,
            patience_us: self.patience_ms * 1_000,
        })
    }
}

/// Wanted readings by the names of monitors [mm].
fn orbit(file: &Path) -> Result<BTreeMap<String, f32>, String> {
    let said = |why: &dyn core::fmt::Display| format!("feedback.orbit_file: {}: {why}", file.display());
    let text = FILE.text(file).map_err(|error| said(&error))?;
    let wanted: BTreeMap<String, f32> = limits::json(&text).map_err(|error| {
        said(&format_args!("expected an object of readings in mm, such as {{\"x_C6\": 1.5}}: {error}"))
    })?;
    match wanted.iter().find(|(_, mm)| mm.abs() > 100.0) {
        Some((name, mm)) => Err(said(&format_args!("{name}: expected -100 to 100 mm, found {mm}"))),
        None => Ok(wanted),
    }
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::*;

    fn of(text: &str) -> Result<stream::Feedback, String> {
        toml::from_str::<Feedback>(text).unwrap().of(&Ring::booster())
    }

    #[test]
    fn by_default_it_is_off_and_all_correctors_bring_the_readings_to_0() {
        assert!(!Feedback::default().on);
        let all = of("").unwrap();
        assert_eq!((all.orbit, all.limit), (vec![0.0; 33], vec![20.0; 48]));
    }

    #[test]
    fn correctors_and_the_wanted_orbit_are_named() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("orbit.json");
        fs::write(&file, "{\"x_E4\": -1.5, \"y_D3\": 2}").unwrap();
        let text = format!("correctors = [\"H_A4\", \"V_F7\"]\norbit_file = {file:?}\nlimit_A = 8");
        let (wanted, ring) = (of(&text).unwrap(), Ring::booster());
        let moved: Vec<usize> = (0..48).filter(|c| wanted.limit[*c] > 0.0).collect();
        assert_eq!((moved, wanted.limit[1]), (vec![1, 47], 8.0));
        let at = |name: &str| wanted.orbit[ring.monitor_names().iter().position(|known| known == name).unwrap()];
        assert_eq!((at("x_E4"), at("y_D3"), at("x_C6")), (-1.5e-3, 2e-3, 0.0));
        fs::write(&file, "{\"x_Z9\": 1}").unwrap();
        let wrong = of(&text.replace("V_F7", "V_F8")).unwrap_err();
        assert_eq!(
            wrong.replace(&ring.name, "the ring"),
            "feedback.correctors: the ring has no \"V_F8\"; feedback.orbit_file: the ring has no monitor \"x_Z9\""
        );
        fs::write(&file, "[1]").unwrap();
        assert!(of(&text).unwrap_err().contains("expected an object of readings in mm"));
    }
}
