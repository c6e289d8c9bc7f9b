//! The last hour, day and month of the estimates in memory, for the curves of the page: 360 points each. The files of the history are
//! read at the start only.

use std::collections::VecDeque;

use results::EstimateRecord;

use crate::health::HealthRecord;
use crate::history::Row;

/// Points of a trail.
const POINTS: usize = 360;
/// Trails by the word that asks for them, and the time from point to point [ms].
const SPANS: [(&str, u64); 3] = [("hour", 10_000), ("day", 240_000), ("month", 7_200_000)];

/// A point of a trail.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Point {
    /// [ms since 1970]
    pub time_ms: u64,
    /// Mean and standard deviation of each var [N].
    pub vars: Vec<[f32; 2]>,
    /// Chi-square over its degrees of freedom.
    pub chi_square: f32,
    pub mismatch: bool,
}

/// One for each span.
#[derive(Debug, Default)]
pub(super) struct Trails {
    points: [VecDeque<Point>; 3],
}

impl Trails {
    /// Add an estimate where a point is due.
    pub fn add(&mut self, time_ms: u64, record: &EstimateRecord, health: &HealthRecord) {
        self.put(time_ms, || Point {
            time_ms,
            vars: record.mean.iter().zip(&record.sigma).map(|(mean, sigma)| [*mean, *sigma]).collect(),
            chi_square: health.fit.chi_square / health.fit.degrees_of_freedom.max(1.0),
            mismatch: record.mismatch == Some(true),
        });
    }

    /// The same for a row of the history, which has the vars at these places.
    pub fn remember(&mut self, row: &Row, places: &[Option<usize>]) {
        let var = |place: &Option<usize>| place.and_then(|at| row.vars.get(at)).copied().unwrap_or([f32::NAN; 2]);
        self.put(row.time_ms, || Point {
            time_ms: row.time_ms,
            vars: places.iter().map(var).collect(),
            chi_square: row.chi_square[0] / row.chi_square[1].max(1.0),
            mismatch: row.mismatch,
        });
    }

    fn put(&mut self, time_ms: u64, point: impl Fn() -> Point) {
        for (points, (_, every)) in self.points.iter_mut().zip(SPANS) {
            if points.back().is_some_and(|last| time_ms.abs_diff(last.time_ms) < every) {
                continue;
            }
            if points.len() == POINTS {
                points.pop_front();
            }
            points.push_back(point());
        }
    }

    /// The points of a span, those that are older than it left out; none if there is no such span.
    pub fn of(&self, span: &str, now_ms: u64) -> Option<impl Iterator<Item = &Point>> {
        let at = SPANS.iter().position(|(word, _)| *word == span)?;
        let since = now_ms.saturating_sub(SPANS[at].1 * POINTS as u64);
        Some(self.points[at].iter().filter(move |point| point.time_ms >= since))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_trail_is_bounded_and_has_points_at_its_distance() {
        let mut trails = Trails::default();
        for second in 0..200_000_u64 {
            let point = || Point { time_ms: 1000 * second, vars: Vec::new(), chi_square: 1.0, mismatch: false };
            trails.put(1000 * second, point);
        }
        let times = |span| trails.of(span, 200_000_000).unwrap().map(|point| point.time_ms).collect::<Vec<_>>();
        assert!(times("hour").is_sorted_by(|a, b| b - a == 10_000));
        assert_eq!((times("hour").len(), times("day").len(), times("month").len()), (360, 360, 28));
        assert!(trails.of("century", 0).is_none());
    }
}
