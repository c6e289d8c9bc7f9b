//! The network in the core, and on the emulated chip: the bits of the host, and how many instructions they take.

use core::time::Duration;

use estimator::Walk;
use estimator::surrogate::SAMPLES;
use inference::Recording;
use inference::stream::{self, Core, Estimate};
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
fn last(mut core: Core, recording: &Recording) -> Estimate {
    let mut last = None;
    stream::replay(&mut core, recording, |_, estimate| last = Some(estimate.clone())).unwrap();
    assert!(core.is_within(), "the recording's ring is one of the training set");
    last.unwrap()
}

/// Measured: 0.43 error bars at most, widths within 4 %.
#[test]
fn the_core_finds_the_vars_that_it_finds_with_the_green_s_function() {
    let ring = Ring::booster();
    let recording = Recording::read(&repository("recordings/paper-vars"), &ring).unwrap();
    let setup = stream::setup(&ring, &recording, Walk::NONE).unwrap();
    let tables = training::green::tables(&ring).unwrap();
    let network = last(Core::with_network(&ring, tables.clone(), setup.clone()).unwrap(), &recording);
    let green = last(Core::with_tables(tables, setup).unwrap(), &recording);
    for i in 0..green.mean.len() {
        let shift = (network.mean[i] - green.mean[i]) / green.sigma[i];
        let width = network.sigma[i] / green.sigma[i];
        assert!(shift.abs() < 0.6 && (width - 1.0).abs() < 0.08, "{i}: {shift} error bars, {width}");
    }
}

#[test]
fn another_ring_is_refused() {
    let ring = Ring::read(&repository("recordings/ten-cells/ring.json")).unwrap();
    let error = training::network::expect_known(&ring).unwrap_err();
    assert!(error.to_string().contains("trained on the built-in Booster"), "{error}");
}
