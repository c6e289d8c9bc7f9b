//! What a frame may not be beyond.

/// A drive beyond what the model describes: another machine state, or a wrong read-back.
#[derive(Debug, Clone, Copy, PartialEq)]
#[cfg_attr(feature = "defmt", derive(defmt::Format))]
pub struct Beyond {
    /// Which part of it.
    pub what: &'static str,
    /// Largest magnitude described.
    pub limit: f32,
    /// What the frame has.
    pub got: f32,
}
