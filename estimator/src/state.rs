//! The state of a core as bytes, for a checkpoint: every number bit for bit, little endian, in the order of the fields.
//!
//! One function passes a value to bytes and back, so that saving and loading cannot differ, and the compiler leads whoever adds
//! a field to it. What is loaded is the state of the same build: [`layout`] says whether it is.

use core::fmt;
use core::marker::PhantomData;

use crc::{CRC_32_ISO_HDLC, Crc, Digest};
use heapless::{Deque, Vec};
use nalgebra::SMatrix;

static CRC: Crc<u32> = Crc::<u32>::new(&CRC_32_ISO_HDLC);

/// Why bytes are no state.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
#[non_exhaustive]
pub enum StateError {
    /// There is no more room, or there are no more bytes.
    Truncated {
        /// How many bytes there are.
        bytes: usize,
    },
    /// Bytes are left over.
    Long {
        /// How many.
        left: usize,
    },
    /// A number that stands for nothing here.
    Value {
        /// Of what.
        what: &'static str,
        /// The number.
        got: u32,
    },
    /// A real number is NaN, which is no state to go on with.
    NotANumber,
    /// Work between frames is under way: it is finished first.
    UnderWay,
}

impl fmt::Display for StateError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Truncated { bytes } => write!(f, "the state does not end within its {bytes} bytes"),
            Self::Long { left } => write!(f, "{left} bytes are left after the state"),
            Self::Value { what, got } => write!(f, "the state has {got} as {what}"),
            Self::NotANumber => write!(f, "the state has NaN as a number"),
            Self::UnderWay => write!(f, "the state cannot be saved while the model is linearised anew"),
        }
    }
}

impl core::error::Error for StateError {}

/// Where the bytes of a state go, or come from.
pub trait Bytes {
    /// Pass the bytes of one number.
    ///
    /// # Errors
    /// [`StateError::Truncated`].
    fn pass(&mut self, bytes: &mut [u8]) -> Result<(), StateError>;

    /// The field that comes next.
    fn field(&mut self, _: &'static str) {}

    /// Wants to know what may be there, and not what is.
    fn is_of_shapes(&self) -> bool {
        false
    }
}

/// A value whose every bit passes to bytes and back.
pub trait State {
    /// Pass it.
    ///
    /// # Errors
    /// [`StateError`]; the value may then be of two states.
    fn pass(&mut self, bytes: &mut impl Bytes) -> Result<(), StateError>;
}

/// Writes a state.
struct Save<'b> {
    rest: &'b mut [u8],
    room: usize,
}

impl Bytes for Save<'_> {
    fn pass(&mut self, bytes: &mut [u8]) -> Result<(), StateError> {
        let error = StateError::Truncated { bytes: self.room };
        let (to, rest) = core::mem::take(&mut self.rest).split_at_mut_checked(bytes.len()).ok_or(error)?;
        to.copy_from_slice(bytes);
        self.rest = rest;
        Ok(())
    }
}

/// Reads a state.
struct Load<'b> {
    rest: &'b [u8],
    length: usize,
}

impl Bytes for Load<'_> {
    fn pass(&mut self, bytes: &mut [u8]) -> Result<(), StateError> {
        let error = StateError::Truncated { bytes: self.length };
        let (from, rest) = self.rest.split_at_checked(bytes.len()).ok_or(error)?;
        bytes.copy_from_slice(from);
        self.rest = rest;
        Ok(())
    }
}

/// Notes which fields there are, and how long.
struct Shape<'c>(Digest<'c, u32>);

impl Bytes for Shape<'_> {
    fn pass(&mut self, bytes: &mut [u8]) -> Result<(), StateError> {
        self.0.update(&[bytes.len() as u8]);
        Ok(())
    }

    fn field(&mut self, name: &'static str) {
        self.0.update(name.as_bytes());
    }

    fn is_of_shapes(&self) -> bool {
        true
    }
}

/// Write a state; returns how many bytes it takes.
///
/// # Errors
/// [`StateError::Truncated`] without room for it.
pub fn save(state: &mut impl State, to: &mut [u8]) -> Result<usize, StateError> {
    let room = to.len();
    let mut save = Save { rest: to, room };
    state.pass(&mut save)?;
    Ok(room - save.rest.len())
}

/// Read a state that fills these bytes.
///
/// # Errors
/// [`StateError`]; the value may then be of two states.
pub fn load(state: &mut impl State, from: &[u8]) -> Result<(), StateError> {
    let mut load = Load { rest: from, length: from.len() };
    state.pass(&mut load)?;
    match load.rest.len() {
        0 => Ok(()),
        left => Err(StateError::Long { left }),
    }
}

/// CRC-32 of the names and lengths of all fields that a state has, whatever is in them: another one is of another program.
pub fn layout(state: &mut impl State) -> u32 {
    let mut shape = Shape(CRC.digest());
    // a shape has room for everything
    let _ = state.pass(&mut shape);
    shape.0.finalize()
}

macro_rules! number {
    ($is_nan:path: $($number:ident),*) => {$(
        impl State for $number {
            #[inline]
            fn pass(&mut self, bytes: &mut impl Bytes) -> Result<(), StateError> {
                let before = self.to_le_bytes();
                let mut after = before;
                bytes.pass(&mut after)?;
                let number = Self::from_le_bytes(after);
                // saving, which changes nothing, goes on with whatever there is
                if $is_nan(number) && after != before {
                    return Err(StateError::NotANumber);
                }
                *self = number;
                Ok(())
            }
        }
    )*};
}

const fn never<T: Copy>(_: T) -> bool {
    false
}

number!(never: u8, u16, i16, u32, i32, u64);
number!(f32::is_nan: f32);
number!(f64::is_nan: f64);

impl State for usize {
    fn pass(&mut self, bytes: &mut impl Bytes) -> Result<(), StateError> {
        // nothing here counts as far as that
        let mut number = *self as u32;
        number.pass(bytes)?;
        *self = number as usize;
        Ok(())
    }
}

impl State for bool {
    fn pass(&mut self, bytes: &mut impl Bytes) -> Result<(), StateError> {
        let mut code = u8::from(*self);
        code.pass(bytes)?;
        *self = match code {
            0 => false,
            1 => true,
            got => return Err(StateError::Value { what: "yes or no", got: got.into() }),
        };
        Ok(())
    }
}

impl State for () {
    fn pass(&mut self, _: &mut impl Bytes) -> Result<(), StateError> {
        Ok(())
    }
}

impl<T> State for PhantomData<T> {
    fn pass(&mut self, _: &mut impl Bytes) -> Result<(), StateError> {
        Ok(())
    }
}

impl<T: State, const N: usize> State for [T; N] {
    fn pass(&mut self, bytes: &mut impl Bytes) -> Result<(), StateError> {
        self.iter_mut().try_for_each(|each| each.pass(bytes))
    }
}

impl<T: State, U: State> State for (T, U) {
    fn pass(&mut self, bytes: &mut impl Bytes) -> Result<(), StateError> {
        self.0.pass(bytes)?;
        self.1.pass(bytes)
    }
}

impl<const R: usize, const C: usize> State for SMatrix<f32, R, C> {
    fn pass(&mut self, bytes: &mut impl Bytes) -> Result<(), StateError> {
        self.iter_mut().try_for_each(|each| each.pass(bytes))
    }
}

/// A value that something which may be absent is made of before it is loaded.
pub trait Blank: State {
    /// Any value.
    const BLANK: Self;
}

macro_rules! blank {
    ($($number:ty),*) => {$(
        impl Blank for $number {
            const BLANK: Self = 0 as $number;
        }
    )*};
}

blank!(u16, u32, f32);

impl<T: Blank, const N: usize> Blank for [T; N] {
    const BLANK: Self = [T::BLANK; N];
}

impl<T: Blank, U: Blank> Blank for (T, U) {
    const BLANK: Self = (T::BLANK, U::BLANK);
}

impl<T: Blank> State for Option<T> {
    fn pass(&mut self, bytes: &mut impl Bytes) -> Result<(), StateError> {
        if bytes.is_of_shapes() {
            return shape_of::<T>(bytes);
        }
        let mut is_some = self.is_some();
        is_some.pass(bytes)?;
        match self {
            _ if !is_some => *self = None,
            Some(value) => value.pass(bytes)?,
            None => self.insert(T::BLANK).pass(bytes)?,
        }
        Ok(())
    }
}

/// The shape of what may be there.
fn shape_of<T: Blank>(bytes: &mut impl Bytes) -> Result<(), StateError> {
    let mut blank = T::BLANK;
    blank.pass(bytes)
}

/// Number of elements in a list with room for `room`.
fn count(length: usize, room: usize, bytes: &mut impl Bytes) -> Result<usize, StateError> {
    let mut count = length;
    count.pass(bytes)?;
    let error = StateError::Value { what: "the length of a list", got: count as u32 };
    if count <= room { Ok(count) } else { Err(error) }
}

impl<T: Blank, const N: usize> State for Vec<T, N> {
    fn pass(&mut self, bytes: &mut impl Bytes) -> Result<(), StateError> {
        if bytes.is_of_shapes() {
            return shape_of::<T>(bytes);
        }
        let count = count(self.len(), N, bytes)?;
        self.truncate(count);
        while self.len() < count && self.push(T::BLANK).is_ok() {}
        self.iter_mut().try_for_each(|each| each.pass(bytes))
    }
}

impl<T: Blank, const N: usize> State for Deque<T, N> {
    fn pass(&mut self, bytes: &mut impl Bytes) -> Result<(), StateError> {
        if bytes.is_of_shapes() {
            return shape_of::<T>(bytes);
        }
        let count = count(self.len(), N, bytes)?;
        while self.len() > count && self.pop_back().is_some() {}
        while self.len() < count && self.push_back(T::BLANK).is_ok() {}
        self.iter_mut().try_for_each(|each| each.pass(bytes))
    }
}

/// The state of a struct: that of each of its fields, all of which are named.
macro_rules! state {
    ([$($generics:tt)*] $type:ty { $($field:ident),* $(,)? }) => {
        impl<$($generics)*> $crate::state::State for $type {
            fn pass(&mut self, bytes: &mut impl $crate::state::Bytes) -> Result<(), $crate::state::StateError> {
                let Self { $($field),* } = self;
                $(
                    bytes.field(stringify!($field));
                    $crate::state::State::pass($field, bytes)?;
                )*
                Ok(())
            }
        }
    };
}
pub(crate) use state;

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug, Clone, PartialEq)]
    struct Some3 {
        flag: bool,
        list: Vec<u32, 3>,
        last: Option<(f32, u16)>,
    }
    state!([] Some3 { flag, list, last });

    fn full() -> Some3 {
        Some3 { flag: true, list: Vec::from_slice(&[7, 8]).unwrap(), last: Some((-0.0, 9)) }
    }

    fn empty() -> Some3 {
        Some3 { flag: false, list: Vec::new(), last: None }
    }

    #[test]
    fn what_was_saved_is_loaded_whatever_was_there() {
        for (from, into) in [(full(), empty()), (empty(), full()), (full(), full())] {
            let (mut bytes, mut from, mut into) = ([0; 64], from, into);
            let n = save(&mut from, &mut bytes).unwrap();
            load(&mut into, &bytes[..n]).unwrap();
            assert_eq!(into, from);
        }
        assert_eq!(save(&mut full(), &mut [0; 64]), Ok(1 + 4 + 8 + 1 + 4 + 2));
    }

    #[test]
    fn bytes_that_are_no_state_are_refused() {
        let mut bytes = [0; 64];
        let n = save(&mut full(), &mut bytes).unwrap();
        assert_eq!(save(&mut full(), &mut [0; 10]), Err(StateError::Truncated { bytes: 10 }));
        assert_eq!(load(&mut empty(), &bytes[..n - 1]), Err(StateError::Truncated { bytes: n - 1 }));
        assert_eq!(load(&mut empty(), &bytes[..n + 2]), Err(StateError::Long { left: 2 }));
        bytes[0] = 2;
        assert_eq!(load(&mut empty(), &bytes[..n]), Err(StateError::Value { what: "yes or no", got: 2 }));
        (bytes[0], bytes[1]) = (1, 4);
        assert_eq!(load(&mut empty(), &bytes[..n]), Err(StateError::Value { what: "the length of a list", got: 4 }));
        let mut no_number = Some3 { last: Some((f32::NAN, 9)), ..full() };
        assert_eq!(save(&mut no_number, &mut bytes), Ok(n));
        assert_eq!(load(&mut full(), &bytes[..n]), Err(StateError::NotANumber));
    }

    #[test]
    fn other_fields_have_another_layout() {
        struct Other {
            flag: bool,
            list: Vec<u32, 3>,
            latest: Option<(f32, u16)>,
        }
        state!([] Other { flag, list, latest });
        let mut other = Other { flag: false, list: Vec::new(), latest: None };
        assert_eq!(layout(&mut empty()), layout(&mut empty()));
        assert_ne!(layout(&mut empty()), layout(&mut other));
    }
}
