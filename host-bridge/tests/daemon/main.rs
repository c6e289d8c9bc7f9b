//! `orbitcal serve CONFIG.toml` as operators run it: a process that is fed, read through shared memory, and killed.

mod faults;
mod kills;
mod place;
mod requests;
mod soak;
mod sources;
mod steering;
