//! Between which settings a difference is taken, and what these are called in a recording.

use inference::Recording;
use inference::recording::Row;

/// Which settings a difference is taken between.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Kind {
    /// From none to the largest positive or negative one, whichever chance takes.
    ZeroToEither,
    /// From none to the largest positive one.
    ZeroToPlus,
    /// From none to the largest negative one.
    ZeroToMinus,
    /// From the largest negative to the largest positive one.
    MinusToPlus,
}

/// The strongest settings of a recording.
#[derive(Debug, Clone)]
pub struct Settings {
    /// Largest setting of each corrector [C] [A].
    largest: Vec<f64>,
    /// The same of all that were set, if it is one.
    common: Option<f64>,
}

/// Share of a corrector's largest setting from which a setting counts as the largest.
const LARGEST: f64 = 0.9;

impl Settings {
    /// Of a recording with `correctors` of them.
    pub fn of(recording: &Recording, correctors: usize) -> Self {
        let mut largest = vec![0.0_f64; correctors];
        for (corrector, setting) in recording.rows.iter().flat_map(|row| &row.correctors) {
            largest[*corrector] = largest[*corrector].max(setting.abs());
        }
        let mut set = largest.iter().copied().filter(|setting| *setting > 0.0);
        let first = set.next();
        let common = first.filter(|first| set.all(|setting| setting == *first));
        Self { largest, common }
    }

    /// Frames in which a corrector alone stands at one of these signs of its largest setting, or at 0.
    pub fn frames(&self, rows: &[Row], corrector: usize, signs: &[f64]) -> Vec<usize> {
        let stands = |row: &Row| {
            let setting = match row.correctors.as_slice() {
                [(set, setting)] if *set == corrector => *setting,
                _ => return false,
            };
            let sign = if setting == 0.0 { 0.0 } else { setting.signum() };
            let is_whole = setting == 0.0 || setting.abs() > LARGEST * self.largest[corrector];
            row.rf_offset == 0.0 && signs.contains(&sign) && is_whole
        };
        rows.iter().enumerate().filter(|(_, row)| stands(row)).map(|(i, _)| i).collect()
    }

    /// The strongest setting in words, `22 A` where it is one for all correctors.
    pub fn strongest(&self) -> String {
        self.common.map_or_else(|| "the largest setting".into(), |setting| format!("{setting} A"))
    }

    /// What a difference is called.
    pub fn words(&self, kind: Kind) -> String {
        match (kind, self.common) {
            (Kind::ZeroToEither, Some(a)) => format!("0 to ±{a} A"),
            (Kind::ZeroToPlus, Some(a)) => format!("0 to +{a} A"),
            (Kind::ZeroToMinus, Some(a)) => format!("0 to -{a} A"),
            (Kind::MinusToPlus, Some(a)) => format!("-{a} A to +{a} A"),
            (Kind::ZeroToEither, None) => "0 to the largest setting of either sign".into(),
            (Kind::ZeroToPlus, None) => "0 to the largest positive setting".into(),
            (Kind::ZeroToMinus, None) => "0 to the largest negative setting".into(),
            (Kind::MinusToPlus, None) => "largest negative to largest positive setting".into(),
        }
    }
}

impl Kind {
    /// Sign of the initial setting, and those that the final one may have.
    pub fn signs(self) -> (f64, &'static [f64]) {
        match self {
            Self::ZeroToEither => (0.0, &[1.0, -1.0]),
            Self::ZeroToPlus => (0.0, &[1.0]),
            Self::ZeroToMinus => (0.0, &[-1.0]),
            Self::MinusToPlus => (-1.0, &[1.0]),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn settings(largest: &[f64], common: Option<f64>) -> Settings {
        Settings { largest: largest.to_vec(), common }
    }

    #[test]
    fn differences_are_called_by_the_settings_of_the_recording() {
        let one = settings(&[22.0, 0.0, 22.0], Some(22.0));
        assert_eq!(one.words(Kind::MinusToPlus), "-22 A to +22 A");
        assert_eq!(one.words(Kind::ZeroToEither), "0 to ±22 A");
        let small = settings(&[0.5], Some(0.5));
        assert_eq!(small.words(Kind::ZeroToMinus), "0 to -0.5 A");
        let several = settings(&[2.0, 3.0], None);
        assert_eq!(several.words(Kind::MinusToPlus), "largest negative to largest positive setting");
    }
}
