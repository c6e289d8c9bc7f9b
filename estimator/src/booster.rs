//! The first machine, the AGS Booster: its sizes, and the types that follow from them.

crate::machine!(monitors: [15, 18], correctors: [24, 24], quadrupoles: 48, params: 48, supplies: 2);
