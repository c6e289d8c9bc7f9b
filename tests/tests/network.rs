//! The network on the emulated chip: the bits of the host, and how many instructions they take.

use core::time::Duration;

use estimator::surrogate::SAMPLES;
use system_tests::qemu::{Emulator, Image, Options};
use training::network::PLANES;

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
