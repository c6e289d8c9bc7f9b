//! Where correctors stand while they are not moved, and how far their read-backs scatter about there.
//!
//! Operators leave correctors at settings of their own, and a campaign moves one at a time from there. A corrector that stays about one level in
//! most frames is idle in these; every other counts from 0.

use nalgebra::DMatrix;
use twin::median;

/// Where each corrector stands while it is idle, and the scatter there.
#[derive(Debug, Clone, PartialEq)]
pub struct Idle {
    /// Median kick of a corrector that is idle in most frames, else 0 [C] [rad].
    pub level: Vec<f64>,
    /// How far its scatter reaches from there; 0 of one that has no level [C] [rad].
    pub scatter: Vec<f64>,
    /// Kick up to which a corrector counts as idle, however little it scatters [rad].
    least: f64,
}

/// That kick, as a share of the largest one.
const IDLE: f64 = 0.05;
/// Standard deviations that the scatter of an idle corrector reaches: of a million read-backs one in a thousand campaigns is beyond.
const SCATTERS: f64 = 6.0;
/// Reach of a scatter, over the largest kick, up to which it is one: a corrector that moves in most frames, as under feedback, has no level.
const SCATTER: f64 = 0.4;
/// Share of the frames in which a corrector has to be idle.
const MOSTLY: f64 = 0.75;
/// Median distance from the mean of a normal, over its standard deviation.
const MEDIAN: f64 = 0.6745;

impl Idle {
    /// Of the kicks of a campaign, rows frames, columns correctors [rad]; `nominal_kick`: the largest that one was set to [rad].
    pub fn from_kicks(kick: &DMatrix<f64>, nominal_kick: f64) -> Self {
        let least = IDLE * nominal_kick;
        let one = |kick: &[f64]| {
            let level = median(kick.iter().copied()).unwrap_or_default();
            let far = median(kick.iter().map(|kick| (kick - level).abs())).unwrap_or_default();
            let scatter = SCATTERS / MEDIAN * far;
            let idle = kick.iter().filter(|kick| (*kick - level).abs() <= scatter.max(least)).count();
            let has_level = scatter <= SCATTER * nominal_kick && idle as f64 >= MOSTLY * kick.len() as f64;
            if has_level { (level, scatter) } else { (0.0, 0.0) }
        };
        let (level, scatter) = kick.column_iter().map(|column| one(column.into_owned().as_slice())).unzip();
        Self { level, scatter, least }
    }

    /// By how much a corrector is moved; none if it is idle [rad].
    pub fn moved(&self, corrector: usize, kick: f64) -> Option<f64> {
        let reach = self.scatter[corrector].max(self.least);
        Some(kick - self.level[corrector]).filter(|moved| moved.abs() > reach)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Sixteen frames at 3 A or so, four of them 22 A higher; one at 0 but for 20 mA; one under feedback.
    fn kicks() -> DMatrix<f64> {
        let wave = |i: usize| (2.7 * (i * i) as f64).sin();
        DMatrix::from_fn(16, 3, |i, corrector| match corrector {
            0 => 3.0 + 0.3 * wave(i) + if i % 5 == 4 { 22.0 } else { 0.0 },
            1 => 0.02 * wave(i),
            _ => 12.0 * wave(i),
        })
    }

    #[test]
    fn a_corrector_is_moved_from_where_it_mostly_stands() {
        let idle = Idle::from_kicks(&kicks(), 22.0);
        assert!((idle.level[0] - 3.0).abs() < 0.2 && idle.level[1].abs() < 0.02 && idle.level[2] == 0.0);
        let moved: Vec<bool> = (0..16).map(|i| idle.moved(0, kicks()[(i, 0)]).is_some()).collect();
        assert_eq!(moved, (0..16).map(|i| i % 5 == 4).collect::<Vec<_>>());
        // what stands at 0 is moved beyond 5 % of the largest kick, and so is what has no level
        for corrector in [1, 2] {
            assert!(idle.moved(corrector, 1.0).is_none() && idle.moved(corrector, 1.2).is_some());
        }
    }
}
