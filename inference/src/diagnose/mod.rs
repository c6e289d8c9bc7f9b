//! Missing physics.
pub mod data;
pub mod discrepancy;
pub mod fit;
pub mod heldout;
pub mod hypothesis;
pub mod scan;
pub mod search;
