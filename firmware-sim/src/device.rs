//! A device: the core, the tables that it goes by, and what it answers to each packet.
//!
//! Each answer is a function of its own, not inlined, so that the stack holds the buffers of one of them at a time.

use estimator::surrogate::Unstable;
use estimator::wire::link::{PIECE, REQUEST, Refusal, Status, Taken, Vitals};
use estimator::wire::{ParcelError, link};
use estimator::{Core, Parcel, Prepared, Tables, packet};
use heapless::Vec;

/// What a device of this core says.
pub type Reply<E> = link::Reply<<E as Core>::Answer>;
/// What it is asked; a line of its tables has at most `L` entries.
pub type Request<E, const L: usize> = link::Request<<E as Core>::Setup, Parcel<L>>;

/// The core and its tables: those in flash, and one slot for others that came over the wire. A line of them has at most `L`
/// entries.
#[derive(Debug)]
pub struct Device<'m, E: Core, const L: usize> {
    core: &'m mut E,
    built_in: &'m E::Tables,
    slot: &'m mut E::Tables,
    contents: Contents,
    setup: Option<E::Setup>,
    wants_covariance: bool,
    refused: u32,
}

/// What the slot holds.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Contents {
    /// Nothing of use.
    Nothing,
    /// Parts of new tables.
    Parts,
    /// The tables in use.
    InUse,
}

impl<'m, E: Core, const L: usize> Device<'m, E, L> {
    /// A device that waits for its setup.
    pub fn new(core: &'m mut E, built_in: &'m E::Tables, slot: &'m mut E::Tables) -> Self {
        Self { core, built_in, slot, contents: Contents::Nothing, setup: None, wants_covariance: false, refused: 0 }
    }

    /// Take a packet in; `reply` hears what there is to say, the answer to a frame first. After a frame, true if an operator should
    /// look: see [`Core::needs_attention`].
    /// `vitals` is asked if the packet asks for the status.
    pub fn hear(
        &mut self,
        bytes: &mut [u8],
        vitals: impl FnOnce() -> Vitals,
        reply: &mut impl FnMut(&Reply<E>),
    ) -> Option<bool> {
        if packet::kind(bytes) == Some(REQUEST) {
            self.obey(bytes, vitals, reply);
            return None;
        }
        self.ingest(bytes, reply)
    }

    /// One slice of what can be done between packets. See [`estimator::Estimator::prepare`].
    pub fn prepare(&mut self) -> Prepared {
        let Some(setup) = &self.setup else { return Prepared::Nothing };
        self.core.prepare(tables(self.contents, self.built_in, self.slot), setup)
    }

    /// Packets refused so far.
    pub fn refused(&self) -> u32 {
        self.refused
    }

    /// Count a packet that was none, and say so.
    #[inline(never)]
    pub fn refuse(&mut self, why: impl Into<Refusal>, reply: &mut impl FnMut(&Reply<E>)) {
        self.refused = self.refused.saturating_add(1);
        reply(&link::Reply::Refused { why: why.into(), count: self.refused });
    }

    /// A frame: the answer, and what was asked for with it.
    #[inline(never)]
    fn ingest(&mut self, bytes: &mut [u8], reply: &mut impl FnMut(&Reply<E>)) -> Option<bool> {
        let Some(setup) = &self.setup else {
            self.refuse(estimator::IngestError::NotStarted, reply);
            return None;
        };
        match self.core.ingest(tables(self.contents, self.built_in, self.slot), setup, bytes) {
            Ok(estimate) => {
                say(|| link::Reply::Estimate((&estimate).into()), reply);
                if core::mem::take(&mut self.wants_covariance) {
                    self.send_covariance(E::sequence(&estimate), reply);
                }
                Some(E::needs_attention(&estimate))
            }
            Err(error) => {
                self.refuse(error, reply);
                None
            }
        }
    }

    #[inline(never)]
    fn send_covariance(&self, sequence: u32, reply: &mut impl FnMut(&Reply<E>)) {
        let params = self.built_in.layout().params();
        let mut places = (0..params).flat_map(|i| (0..=i).map(move |j| (i, j)));
        for first in (0..(params * (params + 1) / 2) as u16).step_by(PIECE) {
            let entries: Vec<f32, PIECE> =
                places.by_ref().take(PIECE).map(|(i, j)| self.core.covariance(i, j)).collect();
            reply(&link::Reply::Covariance { sequence, first, entries });
        }
    }

    #[inline(never)]
    fn obey(&mut self, bytes: &mut [u8], vitals: impl FnOnce() -> Vitals, reply: &mut impl FnMut(&Reply<E>)) {
        match Request::<E, L>::decode(bytes) {
            Ok(link::Request::Restart(setup)) => self.restart(setup, reply),
            Ok(link::Request::ForgetSequence) => {
                self.core.forget_sequence();
                say(|| link::Reply::SequenceForgotten, reply);
            }
            Ok(link::Request::Covariance) => self.wants_covariance = true,
            Ok(link::Request::Status) => {
                let status = self.status(vitals());
                say(|| link::Reply::Status(status), reply);
            }
            Ok(link::Request::Model(parcel)) => {
                let taken = self.load(&parcel);
                say(|| link::Reply::Model(taken), reply);
            }
            Ok(link::Request::BuiltIn) => {
                let taken = self.go_back();
                say(|| link::Reply::Model(taken), reply);
            }
            Err(error) => self.refuse(error, reply),
        }
    }

    #[inline(never)]
    fn restart(&mut self, setup: E::Setup, reply: &mut impl FnMut(&Reply<E>)) {
        if !E::is_sound(&setup) {
            self.refuse(Refusal::Setup, reply);
            return;
        }
        let mut began = self.begin(&setup);
        if began.is_err() && self.contents == Contents::InUse {
            // not the setup's fault: the tables that came over the wire have no design, those in flash do
            self.contents = Contents::Nothing;
            say(|| link::Reply::Model(Err(ParcelError::Unstable)), reply);
            began = self.begin(&setup);
        }
        // a core that has not begun has lost its posterior: it waits for a setup again
        self.setup = began.is_ok().then_some(setup);
        match began {
            Ok(()) => say(|| link::Reply::Restarted, reply),
            Err(Unstable) => self.refuse(Refusal::NoDesign, reply),
        }
    }

    fn begin(&mut self, setup: &E::Setup) -> Result<(), Unstable> {
        self.core.restart(tables(self.contents, self.built_in, self.slot), setup)
    }

    /// Write a part of new tables into the slot; with the last one they are put in use.
    #[inline(never)]
    fn load(&mut self, parcel: &Parcel<L>) -> Result<Taken, ParcelError> {
        match (self.contents, parcel) {
            (Contents::InUse, _) => return Err(ParcelError::Busy),
            (Contents::Nothing, Parcel::Codes { .. } | Parcel::Values { .. } | Parcel::Seal { .. }) => {
                return Err(ParcelError::Headless);
            }
            // another ring's would fit, if it were smaller; but frames and posterior are of this one
            (_, Parcel::Head { sizes, .. }) if *sizes != self.built_in.layout().ring => {
                self.contents = Contents::Nothing;
                return Err(ParcelError::Sizes { room: self.built_in.layout().ring, got: *sizes });
            }
            _ => {}
        }
        // a part that does not fit spoils them all
        self.contents = Contents::Nothing;
        self.slot.take(parcel)?;
        if !matches!(parcel, Parcel::Seal { .. }) {
            self.contents = Contents::Parts;
            return Ok(Taken::Stored);
        }
        if let Some(setup) = &self.setup
            && self.core.adopt(self.slot, setup).is_err()
        {
            // the tables in flash have described all frames so far, so they can again
            let _ = self.core.adopt(self.built_in, setup);
            return Err(ParcelError::Unstable);
        }
        self.contents = Contents::InUse;
        Ok(Taken::InUse)
    }

    #[inline(never)]
    fn go_back(&mut self) -> Result<Taken, ParcelError> {
        if let (Contents::InUse, Some(setup)) = (self.contents, &self.setup)
            && self.core.adopt(self.built_in, setup).is_err()
        {
            // the tables in the slot have described all frames so far, so they can again
            let _ = self.core.adopt(self.slot, setup);
            return Err(ParcelError::Unstable);
        }
        self.contents = Contents::Nothing;
        Ok(Taken::BuiltIn)
    }

    #[inline(never)]
    fn status(&mut self, vitals: Vitals) -> Status {
        let tables = tables(self.contents, self.built_in, self.slot);
        let quality = self.setup.as_ref().map(|setup| self.core.fit_quality(tables, setup));
        Status {
            frames: self.core.frames(),
            refused: self.refused,
            vitals,
            tables: tables.digest::<L>(),
            loaded: self.contents == Contents::InUse,
            chi_square: quality.map_or(0.0, |q| q.chi_square),
            degrees_of_freedom: quality.map_or(0.0, |q| q.degrees_of_freedom),
        }
    }
}

/// Say something. Not inlined: room for a reply is more than a kilobyte, which is not to lie on the stack while the core
/// takes a frame in or goes over to other tables.
#[inline(never)]
fn say<A>(what: impl FnOnce() -> link::Reply<A>, reply: &mut impl FnMut(&link::Reply<A>)) {
    reply(&what());
}

/// The tables in use.
fn tables<'t, G>(contents: Contents, built_in: &'t G, slot: &'t G) -> &'t G {
    if contents == Contents::InUse { slot } else { built_in }
}
