//! Streams as long as weeks, and what happens in them: the core beside the same Gaussian in double precision, and the truth.
//! `cargo run --release -p system-tests --bin soak` streams for hours.

use estimator::booster::{CORRECTORS, Estimate, Frame, PARAMS};
use estimator::{CurrentCode, IntensityCode, PositionCode, Walk};
use system_tests::machine::{amperes, walk_per_cycle};
use system_tests::soak::{Row, Soak};

/// A stream of 100,000 frames, beside double precision and the truth.
fn stays_right(row: Row) {
    let mut soak = Soak::new(row, 1, Walk::NONE).unwrap();
    for _ in 0..5 {
        let c = soak.run(20_000);
        // 48 degrees: 0.5 to 1.6 holds with 99.5 %
        assert!((0.5..1.6).contains(&c.nees), "{row:?}: {c:?}");
        assert!(c.sigma_ratio[0] > 0.95 && c.sigma_ratio[1] < 1.05, "{row:?}: {c:?}");
        // mean and scatter of chi-square of 33 degrees; of 20,000 frames 0.2 %
        assert!((c.nis / 33.0 - 1.0).abs() < 0.05 && (c.nis_scatter / 8.12 - 1.0).abs() < 0.05, "{row:?}: {c:?}");
        assert!(c.evidence.abs() < 0.1, "{row:?}: {c:?}");
    }
}

#[test]
#[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
fn a_feedback_of_many_correctors_stays_right() {
    stays_right(Row::Several);
}

#[test]
#[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
fn a_campaign_without_end_stays_right() {
    stays_right(Row::Single);
}

#[test]
#[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
fn kicks_below_what_counts_as_powered_stay_right() {
    stays_right(Row::Faint);
}

#[test]
#[cfg_attr(debug_assertions, ignore = "minutes without optimisation")]
fn a_scan_about_a_steady_correction_stays_right() {
    stays_right(Row::Steady);
}

/// Largest shift of a param between two estimates, in error bars.
fn shift(from: &Estimate, to: &Estimate) -> f32 {
    (0..PARAMS).map(|i| (from.map_params[i] - to.map_params[i]).abs() / from.params_sigma[i]).fold(0.0, f32::max)
}

/// So many frames of a stream; the estimate after the last.
fn stream(soak: &mut Soak, frames: u32) -> Estimate {
    (0..frames).map(|_| next(soak)).last().unwrap()
}

fn next(soak: &mut Soak) -> Estimate {
    let frame = soak.cycle();
    soak.ingest(&frame)
}

/// What monitors read of no beam: nothing, their noise, or anything.
fn without_beam(soak: &mut Soak, kind: usize) -> Frame {
    let mut frame = soak.cycle();
    let size = [0.0, 1.5e-4, 5e-3][kind];
    for reading in &mut frame.reading {
        *reading = PositionCode::nearest(size * soak.machine.random.normal()).unwrap();
    }
    frame
}

#[test]
#[cfg_attr(debug_assertions, ignore = "a minute without optimisation")]
fn frames_without_beam_are_flagged_and_change_nothing() {
    for row in [Row::Several, Row::Single] {
        for (kind, process_noise) in [(0, 0.0), (1, 0.0), (2, 0.0), (1, 1e-4)] {
            let mut soak = Soak::new(row, 2, walk_per_cycle(process_noise)).unwrap();
            let before = stream(&mut soak, 300);
            for burst in [1, 2, 10, 20] {
                // given a lost beam of so many frames
                for at in 0..burst {
                    let frame = without_beam(&mut soak, kind);
                    let estimate = soak.ingest(&frame);
                    // then each is flagged, and the vars stay; with a walk they spread
                    let moved = shift(&before, &estimate);
                    assert!(
                        estimate.remarks.put_aside,
                        "{row:?}, kind {kind}, {at} of {burst}: {:?}",
                        estimate.remarks
                    );
                    assert!(estimate.accepted.is_empty() && (burst > 1 || moved < 0.2), "{row:?}: {moved} sigma");
                }
                // and the first good frame counts
                let after = next(&mut soak);
                assert!(!after.remarks.put_aside && after.accepted.count() > 30, "{row:?}, kind {kind}, after {burst}");
            }
            let last = stream(&mut soak, 100);
            assert!((0.5..1.6).contains(&soak.nees(&last)), "{row:?}, kind {kind}: NEES/48 {}", soak.nees(&last));
        }
    }
}

#[test]
#[cfg_attr(debug_assertions, ignore = "a minute without optimisation")]
fn a_frame_without_particles_is_flagged_whatever_it_reads() {
    let mut soak = Soak::new(Row::Several, 6, Walk::NONE).unwrap();
    let particles = |at| match at {
        40 => 0.0,
        50 => 4e13, // a wrong reading, 90 times the others
        99 => 1e7,
        _ => 4.5e11,
    };
    let flagged = (0..100).filter(|at| {
        let frame = Frame { intensity: IntensityCode::nearest(particles(*at)), ..soak.cycle() };
        soak.ingest(&frame).remarks.put_aside
    });
    assert_eq!(flagged.collect::<Vec<i32>>(), [40, 99]);
}

#[test]
#[cfg_attr(debug_assertions, ignore = "a minute without optimisation")]
fn baselines_that_move_are_said_and_leave_the_vars_alone() {
    for row in [Row::Several, Row::Single] {
        let mut soak = Soak::new(row, 3, Walk::NONE).unwrap();
        let before = stream(&mut soak, 500);
        soak.machine.move_baselines(5e-3);
        let after: Vec<Estimate> = (0..20).map(|_| next(&mut soak)).collect();
        let said: Vec<usize> = (0..20).filter(|i| after[*i].remarks.baselines_moved).collect();
        assert_eq!(said, [9], "{row:?}");
        assert!(after[19].accepted.count() > 30, "{row:?}");
        let moved = shift(&before, &after[9]);
        assert!(moved < 0.2, "{row:?}: {moved} sigma");
        let last = stream(&mut soak, 1000);
        assert!((0.5..1.6).contains(&soak.nees(&last)), "{row:?}: NEES/48 {}", soak.nees(&last));
    }
}

/// One corrector of a campaign off a steady correction.
fn scanned(steady: f64, corrector: usize, by: f64) -> [CurrentCode; CORRECTORS] {
    core::array::from_fn(|c| amperes(steady * [1.0, -1.0][c % 2] + if c == corrector { by } else { 0.0 }))
}

/// Three currents a corrector are 144 settings, for which there is no room: the first ones stay those of the campaign.
#[test]
fn a_campaign_of_more_settings_than_there_is_room_for_keeps_the_first() {
    let mut soak = Soak::new(Row::Single, 6, Walk::NONE).unwrap();
    let mut scan = || {
        let settings = (0..CORRECTORS).flat_map(|c| [22.0, -22.0, 11.0].map(|by| scanned(0.0, c, by)));
        settings.map(|drive| soak.powered(drive).setting).collect::<Vec<_>>()
    };
    let (first, again) = (scan(), scan());
    assert_eq!(first[..99], (0..99).map(Some).collect::<Vec<_>>());
    assert!(first[99..].iter().all(Option::is_none));
    assert_eq!(first, again);
}

/// A steady correction that changes five times retires the settings about the former ones. Chi-square of 33,000 readings is known to
/// a hundredth of itself.
#[test]
#[cfg_attr(debug_assertions, ignore = "a minute without optimisation")]
fn settings_that_are_retired_leave_a_chi_square_of_one_a_degree() {
    let mut soak = Soak::new(Row::Steady, 7, Walk::NONE).unwrap();
    for steady in [3.0, -2.0, 4.0, -3.0, 2.0] {
        for _ in 0..2 {
            for c in 0..CORRECTORS {
                for by in [22.0, -22.0] {
                    soak.powered(scanned(steady, c, by));
                }
            }
        }
    }
    let quality = soak.quality();
    let ratio = f64::from(quality.chi_square / quality.degrees_of_freedom);
    assert!((ratio - 1.0).abs() < 0.04 && !quality.is_mismatch(), "{quality:?}");
}

#[test]
#[cfg_attr(debug_assertions, ignore = "a minute without optimisation")]
fn a_long_gap_is_a_long_walk() {
    let (walk, gap) = (5e-5, 30_000);
    for row in [Row::Several, Row::Single] {
        let mut soak = Soak::new(row, 5, walk_per_cycle(walk)).unwrap();
        stream(&mut soak, 200);
        soak.skip(gap);
        soak.machine.walk(walk * (gap as f32).sqrt());
        let first = next(&mut soak);
        assert!(first.params_sigma.iter().all(|sigma| *sigma > 2e-3), "{row:?}: {:?}", first.params_sigma);
        let last = stream(&mut soak, 300);
        assert!((0.5..1.6).contains(&soak.nees(&last)), "{row:?}: NEES/48 {}", soak.nees(&last));
    }
}

#[test]
#[cfg_attr(debug_assertions, ignore = "a minute without optimisation")]
fn a_front_end_that_restarts_is_heard() {
    let mut soak = Soak::new(Row::Several, 5, Walk::NONE).unwrap();
    let before = stream(&mut soak, 300);
    // its count begins at 0 again
    soak.restart_front_end();
    let after = next(&mut soak);
    assert_eq!((after.sequence, after.frames), (0, before.frames + 1));
    assert!(shift(&before, &after) < 1.0);
    // and wraps
    for _ in 0..2 {
        soak.skip(i32::MAX as u32 - 2);
        next(&mut soak);
    }
    let wrapped = stream(&mut soak, 10);
    assert!(wrapped.sequence < 10, "{}", wrapped.sequence);
}
