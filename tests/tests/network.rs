//! The network in the core, and on the emulated chip: the bits of the host, and how many instructions they take.

use core::time::Duration;

use estimator::Walk;
use estimator::surrogate::SAMPLES;
use inference::Recording;
use inference::stream::{self, Core, Estimate, Feedback};
use system_tests::qemu::{Emulator, Image, Options};
use system_tests::repository;
use training::network::PLANES;
use twin::Ring;

/// It takes seconds; a busy machine may need more.
const LIMIT: Duration = Duration::from_secs(120);

/// The image compares itself with digests that the host wrote into it, and ends with status 0 if they agree.
#[test]
fn outputs_and_jacobians_are_those_of_the_host_to_the_bit() {
    let image = Image::build_of("network").unwrap();
    let regions = ["Network::forward", "Network::back"].map(|name| image.function(name).unwrap());
    let options = Options { regions: regions.to_vec(), ..Options::default() };
    let run = Emulator::start(&image, &options).unwrap().wait(LIMIT).unwrap();
    assert_eq!(run.status, Some(0), "{:?} {}", image.log(&run.stdout), run.stderr);
    let outputs: usize = PLANES.iter().map(|plane| plane.shape().1).sum();
    let (forward, back) = (&run.counts["Network::forward"], &run.counts["Network::back"]);
    assert_eq!((forward.len(), back.len()), (2 * SAMPLES, outputs * SAMPLES));
    println!("instructions of a value {forward:?}, of one line of the Jacobian {back:?}; {:?}", image.sizes().unwrap());
}

/// Estimate after a whole recording.
fn last(core: &mut Core, recording: &Recording) -> Estimate {
    let mut last = None;
    stream::replay(core, recording, |_, estimate| last = Some(estimate.clone())).unwrap();
    assert!(core.is_within(), "the recording's ring is one of the training set");
    last.unwrap()
}

/// Measured: 0.77 error bars at most, widths within 6 %.
#[test]
fn the_core_finds_the_vars_that_it_finds_with_the_green_s_function() {
    let ring = Ring::booster();
    let recording = Recording::read(&repository("recordings/paper-vars"), &ring).unwrap();
    let setup = stream::setup(&ring, &recording, Walk::NONE).unwrap();
    let tables = training::green::tables(&ring).unwrap();
    let network = last(&mut Core::with_network(&ring, tables.clone(), setup.clone()).unwrap(), &recording);
    let green = last(&mut Core::with_tables(tables, setup).unwrap(), &recording);
    for i in 0..green.mean.len() {
        let shift = (network.mean[i] - green.mean[i]) / green.sigma[i];
        let width = network.sigma[i] / green.sigma[i];
        assert!(shift.abs() < 1.0 && (width - 1.0).abs() < 0.1, "{i}: {shift} error bars, {width}");
    }
}

/// Set points of three correctors after 20 frames, beside the Green's function: the network's error of the response moves them by a few per cent.
#[test]
fn the_feedback_steers_with_it_as_with_the_green_s_function() {
    let ring = Ring::booster();
    let mut recording = Recording::read(&repository("recordings/paper-vars"), &ring).unwrap();
    recording.rows.truncate(20);
    let used = ["H_A4", "H_C4", "V_D3"];
    let names = ring.corrector_names();
    let limit = names.iter().map(|name| if used.contains(&name.as_str()) { 20.0 } else { 0.0 });
    let feedback = Feedback {
        orbit: vec![0.0; ring.read_monitors.len()],
        limit: limit.collect(),
        walk: 5e-6,
        step_kick: 0.02e-3,
        total_kick: 1e-3,
        rate: 2.0,
        probe: 1.0,
        close: 0.3,
        patience_us: 10_000_000,
    };
    let setup = stream::setup(&ring, &recording, Walk::NONE).unwrap();
    let tables = training::green::tables(&ring).unwrap();
    let steered = |mut core: Core| {
        core.steer(Some(&feedback));
        last(&mut core, &recording);
        core.correction().unwrap().setpoint
    };
    let network = steered(Core::with_network(&ring, tables.clone(), setup.clone()).unwrap());
    let green = steered(Core::with_tables(tables, setup).unwrap());
    let first = &recording.rows[0].corrector_current;
    let each = used.map(|used| names.iter().position(|name| name == used).unwrap());
    let moved = |setpoint: &[f32]| each.map(|c| setpoint[c] - first[c] as f32);
    let (network, green) = (moved(&network), moved(&green));
    for (network, green) in network.iter().zip(green) {
        assert!(green.abs() > 0.1, "{green} A");
        assert!((network / green - 1.0).abs() < 0.1, "{network} A, {green} A by the Green's function");
    }
}

#[test]
fn another_ring_is_refused() {
    let ring = Ring::read(&repository("recordings/ten-cells/ring.json")).unwrap();
    let error = training::network::expect_known(&ring).unwrap_err();
    assert!(error.to_string().contains("trained on the built-in Booster"), "{error}");
}
