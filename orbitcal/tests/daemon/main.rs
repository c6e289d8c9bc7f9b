//! `orbitcal serve CONFIG.toml` as operators run it: a process that is fed, read through shared memory, and killed.

mod attack;
mod clients;
mod faults;
mod history;
mod kills;
mod operation;
mod page;
mod place;
mod requests;
mod soak;
mod sources;
mod steering;
