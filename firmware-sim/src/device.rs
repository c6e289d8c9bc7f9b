//! A device: the core, the feedback on it, the tables that they go by, and what it answers to each packet.
//!
//! Each answer is a function of its own, not inlined, so that the stack holds the buffers of one of them at a time.

use estimator::surrogate::Unstable;
use estimator::wire::link::{Correction, Form, PIECE, REQUEST, Refusal, Status, Taken, UNASKED, Vitals};
use estimator::wire::{ParcelError, link, listed};
use estimator::{Core, Layout, Parcel, Prepared, Steering, Tables, packet};

/// What a device of this core says.
pub type Reply<E> = link::Reply<<E as Core>::Answer, <E as Core>::Setpoints>;
/// What it is asked; a line of its tables has at most `L` entries.
pub type Request<E, S, const L: usize> = link::Request<<E as Core>::Setup, Parcel<L>, <S as Steering<E>>::Feedback>;

/// The core, the feedback, and their tables: those in flash, and one slot for others that came over the wire. A line of them has at most
/// `L` entries.
#[derive(Debug)]
pub struct Device<'m, E: Core, S: Steering<E>, const L: usize> {
    core: &'m mut E,
    steer: &'m mut S,
    built_in: &'m E::Tables,
    slot: &'m mut E::Tables,
    contents: Contents,
    setup: Option<E::Setup>,
    form: Form,
    /// What is wanted of the orbit, while the device steers.
    feedback: Option<S::Feedback>,
    /// The work for the feedback after the last frame is done.
    prepared: bool,
    /// Number of the request for a covariance that is due.
    wants_covariance: Option<u32>,
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

impl<'m, E: Core, S: Steering<E>, const L: usize> Device<'m, E, S, L> {
    /// A device that waits for its setup.
    pub fn new(core: &'m mut E, steer: &'m mut S, built_in: &'m E::Tables, slot: &'m mut E::Tables) -> Self {
        Self {
            core,
            steer,
            built_in,
            slot,
            contents: Contents::Nothing,
            setup: None,
            form: Form::Full,
            feedback: None,
            prepared: false,
            wants_covariance: None,
            refused: 0,
        }
    }

    /// Take a packet in; `reply` hears what there is to say, the answer to a frame first, and of which request it is. After a frame,
    /// true if an operator should look: see [`Core::needs_attention`]. `vitals` is asked if the packet asks for the status.
    pub fn hear(
        &mut self,
        bytes: &mut [u8],
        vitals: impl FnOnce() -> Vitals,
        reply: &mut impl FnMut(u32, &Reply<E>),
    ) -> Option<bool> {
        if packet::kind(bytes) == Some(REQUEST) {
            self.obey(bytes, vitals, reply);
            return None;
        }
        self.ingest(bytes, reply)
    }

    /// One slice of what can be done between packets: the core's first, then the feedback's, of which there is at most one a frame. See
    /// [`estimator::Estimator::prepare`] and [`estimator::Estimator::prepare_steer`].
    pub fn prepare(&mut self) -> Prepared {
        let Some(setup) = &self.setup else { return Prepared::Nothing };
        let tables = tables(self.contents, self.built_in, self.slot);
        let prepared = self.core.prepare(tables, setup);
        let Some(feedback) = self.feedback.as_ref().filter(|_| prepared == Prepared::Nothing && !self.prepared) else {
            return prepared;
        };
        self.prepared = true;
        if self.steer.prepare(self.core, (tables, setup), feedback) { Prepared::Slice } else { Prepared::Nothing }
    }

    /// Packets refused so far.
    pub fn refused(&self) -> u32 {
        self.refused
    }

    /// Count a packet that was none, and say so.
    pub fn refuse(&mut self, why: Refusal, reply: &mut impl FnMut(u32, &Reply<E>)) {
        self.refuse_to(UNASKED, why, reply);
    }

    /// Count a request that is not met, or a frame that is not used, and say so.
    #[inline(never)]
    fn refuse_to(&mut self, number: u32, why: impl Into<Refusal>, reply: &mut impl FnMut(u32, &Reply<E>)) {
        self.refused = self.refused.saturating_add(1);
        reply(number, &link::Reply::Refused { why: why.into(), count: self.refused });
    }

    /// A frame: the answer, and what was asked for with it; true if an operator should look.
    #[inline(never)]
    fn ingest(&mut self, bytes: &mut [u8], reply: &mut impl FnMut(u32, &Reply<E>)) -> Option<bool> {
        let taken = match (&self.setup, &self.feedback) {
            (None, _) => Err(Refusal::NotStarted),
            (Some(_), None) => self.answer(bytes, reply),
            (Some(_), Some(_)) => self.act(bytes, reply),
        };
        match taken {
            Ok(sequence) => {
                if let Some(number) = self.wants_covariance.take() {
                    self.send_covariance(number, sequence, reply);
                }
                Some(self.core.needs_attention())
            }
            Err(why) => {
                self.refuse(why, reply);
                None
            }
        }
    }

    /// Reply by what a frame has taught; its number.
    #[inline(never)]
    fn answer(&mut self, bytes: &mut [u8], reply: &mut impl FnMut(u32, &Reply<E>)) -> Result<u32, Refusal> {
        let setup = self.setup.as_ref().ok_or(Refusal::NotStarted)?;
        let tables = tables(self.contents, self.built_in, self.slot);
        let estimate = self.core.ingest(tables, setup, bytes)?;
        match self.form {
            Form::Full => say(UNASKED, || link::Reply::Estimate((&estimate).into()), reply),
            Form::Short => say(UNASKED, || link::Reply::Short(self.core.short(&estimate)), reply),
        }
        Ok(E::sequence(&estimate))
    }

    /// Steer, and reply by the setpoints if that is to be in short: the correctors do not wait until the frame is learnt. Its number.
    #[inline(never)]
    fn act(&mut self, bytes: &mut [u8], reply: &mut impl FnMut(u32, &Reply<E>)) -> Result<u32, Refusal> {
        let (Some(setup), Some(feedback)) = (&self.setup, &self.feedback) else { return Err(Refusal::NotStarted) };
        let tables = tables(self.contents, self.built_in, self.slot);
        // at its place from the start: a copy is more than a kilobyte of stack
        let mut judged = self.steer.judge(self.core, (tables, setup), feedback, bytes);
        let judged = judged.as_mut().map_err(|error| *error)?;
        let prepared = core::mem::take(&mut self.prepared);
        if self.form == Form::Short {
            let correction = Correction { steered: self.steer.steered(), prepared, setpoints: self.steer.setpoints() };
            say(UNASKED, || link::Reply::Short(self.core.corrected(judged, correction)), reply);
        }
        self.core.learn(tables, setup, judged);
        if self.form == Form::Full {
            say(UNASKED, || link::Reply::Estimate((&self.core.estimate(tables, setup, judged)).into()), reply);
        }
        Ok(E::number(judged))
    }

    #[inline(never)]
    fn send_covariance(&self, number: u32, sequence: u32, reply: &mut impl FnMut(u32, &Reply<E>)) {
        let params = self.built_in.layout().params();
        let mut places = (0..params).flat_map(|i| (0..=i).map(move |j| (i, j)));
        for first in (0..(params * (params + 1) / 2) as u32).step_by(PIECE) {
            let entries = listed(places.by_ref().take(PIECE).map(|(i, j)| self.core.covariance(i, j)));
            reply(number, &link::Reply::Covariance { sequence, first, entries });
        }
    }

    #[inline(never)]
    fn obey(&mut self, bytes: &mut [u8], vitals: impl FnOnce() -> Vitals, reply: &mut impl FnMut(u32, &Reply<E>)) {
        let (number, request) = Request::<E, S, L>::decode(bytes);
        match request {
            Ok(link::Request::Restart(setup)) => self.restart(number, setup, reply),
            Ok(link::Request::ForgetSequence) => {
                self.core.forget_sequence();
                say(number, || link::Reply::SequenceForgotten, reply);
            }
            Ok(link::Request::Covariance) => self.wants_covariance = Some(number),
            Ok(link::Request::Status) => {
                let status = self.status(vitals());
                say(number, || link::Reply::Status(status), reply);
            }
            Ok(link::Request::Model(parcel)) => {
                let taken = self.load(&parcel);
                say(number, || link::Reply::Model(taken), reply);
            }
            Ok(link::Request::BuiltIn) => {
                let taken = self.go_back();
                say(number, || link::Reply::Model(taken), reply);
            }
            Ok(link::Request::Form(form)) => {
                self.form = form;
                say(number, || link::Reply::Form(form), reply);
            }
            Ok(link::Request::Feedback(feedback)) => self.switch(number, feedback, reply),
            Err(error) => self.refuse_to(number, error, reply),
        }
    }

    /// Steer from the next frame on, or no more.
    #[inline(never)]
    fn switch(&mut self, number: u32, feedback: Option<S::Feedback>, reply: &mut impl FnMut(u32, &Reply<E>)) {
        if feedback.as_ref().is_some_and(|feedback| !S::is_sound(feedback)) {
            self.refuse_to(number, Refusal::Setup, reply);
            return;
        }
        *self.steer = S::BLANK;
        (self.feedback, self.prepared) = (feedback, false);
        say(number, || link::Reply::Feedback(self.feedback.is_some()), reply);
    }

    #[inline(never)]
    fn restart(&mut self, number: u32, setup: E::Setup, reply: &mut impl FnMut(u32, &Reply<E>)) {
        if !E::is_sound(&setup) {
            self.refuse_to(number, Refusal::Setup, reply);
            return;
        }
        let mut began = self.begin(&setup);
        if began.is_err() && self.contents == Contents::InUse {
            // not the setup's fault: the tables that came over the wire have no design, those in flash do
            self.contents = Contents::Nothing;
            say(number, || link::Reply::Model(Err(ParcelError::Unstable)), reply);
            began = self.begin(&setup);
        }
        // a core that has not begun has lost its posterior: it waits for a setup again
        self.setup = began.is_ok().then_some(setup);
        (self.form, self.feedback) = (Form::Full, None);
        match began {
            Ok(()) => say(number, || link::Reply::Restarted, reply),
            Err(Unstable) => self.refuse_to(number, Refusal::NoDesign, reply),
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
        let Layout { ring, .. } = self.built_in.layout();
        Status {
            version: link::VERSION,
            frame_version: E::FRAME_VERSION,
            ring,
            room: E::ROOM,
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
fn say<R>(number: u32, what: impl FnOnce() -> R, reply: &mut impl FnMut(u32, &R)) {
    reply(number, &what());
}

/// The tables in use.
fn tables<'t, G>(contents: Contents, built_in: &'t G, slot: &'t G) -> &'t G {
    if contents == Contents::InUse { slot } else { built_in }
}
