//! Missing physics.
pub mod data;
pub mod fit;
pub mod hypothesis;
pub mod scan;
