//! A feedback that runs for long on the emulated chip, on a bad line, beside the core in process.

use core::error::Error;
use std::io::{Read, Write};

use estimator::wire::link::{Form, Short, Status};
use host_bridge::source::link::{Link, LinkError};
use inference::Recording;
use inference::stream::{self, Core, Estimate};
use training::rooms::largest::{Reply, Request, Setpoints};
use twin::Ring;

use crate::faults::{FAULTS, faulty};
use crate::machine::{Machine, Random, walk_per_cycle, wire_of};
use crate::qemu::{Emulator, Image, Options};
use crate::repository;
use crate::sil::is_same;

/// Random walk that the core expects of each theta, per square root of a cycle.
const WALK: f32 = 1e-5;
/// From one fault on the line to the next, and from one estimate in full to the next [frames].
const FAULT: u32 = 3;
const FULL: u32 = 500;

/// What a long run showed.
#[derive(Debug)]
pub struct Endured {
    /// Sequence numbers of frames whose replies differ from the core in process in any bit.
    pub different: Vec<u32>,
    /// Packets whose refusal was heard.
    pub refused: u32,
    /// How the device was at the end.
    pub status: Status,
}

/// Send so many frames; `tick` hears of each. Replies are short, and compared in what they say; every 500th and the last one are in
/// full, and compared with the covariance.
///
/// # Errors
/// Whatever stops the emulator, the line or the core.
pub fn endure(image: &Image, frames: u32, mut tick: impl FnMut()) -> Result<Endured, Box<dyn Error>> {
    let ring = Ring::booster();
    let recording = Recording::read(&repository("recordings/paper-vars"), &ring)?;
    let mut core = stream::estimator(&ring, &recording, walk_per_cycle(WALK))?;
    let (mut machine, mut random) = (Machine::drawn(&core, 1), Random::new(2));
    let emulator = Emulator::start(image, &Options::default())?;
    let mut link = Link::new(emulator.uart());
    link.restart(&core.setup)?;
    link.form(Form::Short)?;
    let first = wire_of(&machine.cycle(0));
    let (mut different, mut refused, mut last) = (Vec::new(), 0, first.clone());
    for sequence in 1..=frames {
        let wire = wire_of(&machine.cycle(sequence));
        if sequence > 1 && sequence % FAULT == 0 {
            let fault = (sequence / FAULT) as usize % FAULTS;
            refused += spoil(&mut link, &faulty(fault, &last, &wire, &first, &mut random).0)?;
        }
        let is_equal = if sequence % FULL == 0 || sequence == frames {
            agree_in_full(&mut link, &mut core, sequence, &wire)?
        } else {
            let short = link.feedback(sequence, &wire)?;
            do_slices(&mut core, short.remarks.slices);
            says(&core.ingest(&mut wire.clone())?, &short)
        };
        different.extend((!is_equal).then_some(sequence));
        last = wire;
        tick();
    }
    Ok(Endured { different, refused, status: link.status()? })
}

/// Do as many slices as the device has done.
fn do_slices(core: &mut Core, number: u32) {
    for _ in 0..number {
        let _ = core.slice();
    }
}

/// True if a short reply says what an estimate says.
fn says(estimate: &Estimate, short: &Short<Setpoints>) -> bool {
    short.nis.to_bits() == estimate.nis.to_bits() && short.remarks == estimate.remarks
}

fn agree_in_full<L: Read + Write>(
    link: &mut Link<L>,
    core: &mut Core,
    sequence: u32,
    wire: &[u8],
) -> Result<bool, LinkError> {
    link.form(Form::Full)?;
    let mut heard = link.ingest(sequence, wire)?;
    heard.estimate.rejected_frames = 0; // the core in process hears good frames only
    link.form(Form::Short)?;
    do_slices(core, heard.estimate.remarks.slices);
    Ok(is_same(core, wire.to_vec(), &heard))
}

/// Send a faulty packet between two zeros; returns the number of refusals that it gets.
fn spoil<L: Read + Write>(link: &mut Link<L>, bytes: &[u8]) -> Result<u32, Box<dyn Error>> {
    link.write(&[&[0], bytes, &[0]].concat())?;
    // what comes before the reply to this is about the faulty packet
    let number = link.send(&Request::Form(Form::Short))?;
    let mut refused = 0;
    loop {
        match link.next()? {
            (of, Reply::Form(Form::Short)) if of == number => return Ok(refused),
            (_, Reply::Refused { .. }) => refused += 1,
            (_, other) => return Err(format!("{other:?}").into()),
        }
    }
}
