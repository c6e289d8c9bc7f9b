//! The frames of a loop on the emulated chip, beside the core in process.

use core::error::Error;

use estimator::booster::Frame;
use host_bridge::source::link::Link;

use super::Known;
use crate::machine::LAYOUT;
use crate::qemu::{Emulator, Image, Options};
use crate::sil::is_same;

/// Send frames through the image; returns how many estimates differ from the host's in any bit, covariances included. The setpoints
/// are a function of these and of the frames, and so are the host's.
///
/// # Errors
/// Whatever stops the emulator, the line or the core.
pub fn on_chip(image: &Image, wires: &[Vec<u8>]) -> Result<usize, Box<dyn Error>> {
    let emulator = Emulator::start(image, &Options::default())?;
    let mut core = Known::core()?;
    let mut link = Link::new(emulator.uart());
    link.restart(&core.setup)?;
    let mut different = 0;
    for wire in wires {
        let sequence = Frame::decode(&LAYOUT, &mut wire.clone())?.sequence;
        let heard = link.ingest(sequence, wire)?;
        for _ in 0..heard.estimate.remarks.slices {
            let _ = core.slice();
        }
        different += usize::from(!is_same(&mut core, wire.clone(), &heard));
    }
    Ok(different)
}
