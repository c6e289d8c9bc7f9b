//! All types of one machine from the few numbers that are its own.

/// Make the constants and the types of a core for a machine of so many monitors in x and y, correctors in x and y,
/// quadrupoles, params and supplies, and of so many times in the cycle with baselines of their own (one if it is left out). Everything
/// else follows: two nodes a quadrupole, room for each corrector up and down, for none, and for two settings of the RF.
///
/// ```
/// mod small {
///     estimator::machine!(monitors: [3, 2], correctors: [2, 2], quadrupoles: 6, params: 4, supplies: 2);
/// }
/// assert_eq!((small::NODES, small::SETTINGS, small::TRIANGLE), (12, 11, 10));
/// ```
#[macro_export]
macro_rules! machine {
    (
        monitors: [$monitors_x:expr, $monitors_y:expr],
        correctors: [$correctors_x:expr, $correctors_y:expr],
        quadrupoles: $quadrupoles:expr,
        params: $params:expr,
        supplies: $supplies:expr
    ) => {
        $crate::machine!(
            monitors: [$monitors_x, $monitors_y],
            correctors: [$correctors_x, $correctors_y],
            quadrupoles: $quadrupoles,
            params: $params,
            supplies: $supplies,
            times: 1
        );
    };
    (
        monitors: [$monitors_x:expr, $monitors_y:expr],
        correctors: [$correctors_x:expr, $correctors_y:expr],
        quadrupoles: $quadrupoles:expr,
        params: $params:expr,
        supplies: $supplies:expr,
        times: $times:expr
    ) => {
        /// Monitors in x and in y.
        pub const MONITORS_BY_PLANE: [usize; 2] = [$monitors_x, $monitors_y];
        /// Correctors in x and in y.
        pub const CORRECTORS_BY_PLANE: [usize; 2] = [$correctors_x, $correctors_y];
        /// Monitors.
        pub const MONITORS: usize = $monitors_x + $monitors_y;
        /// Correctors.
        pub const CORRECTORS: usize = $correctors_x + $correctors_y;
        /// Quadrupoles, fitted or not.
        pub const QUADRUPOLES: usize = $quadrupoles;
        /// Params.
        pub const PARAMS: usize = $params;
        /// Supplies of quadrupoles.
        pub const SUPPLIES: usize = $supplies;
        /// Nodes: two a quadrupole.
        pub const NODES: usize = 2 * QUADRUPOLES;
        /// Pairs of nodes.
        pub const PAIRS: usize = NODES * (NODES + 1) / 2;
        /// Entries of the lower triangle of a covariance of the params.
        pub const TRIANGLE: usize = PARAMS * (PARAMS + 1) / 2;
        /// Times in the cycle that have baselines of their own, where the machine file has a ramp.
        pub const TIMES: usize = $times;
        /// Settings that are kept apart: each corrector up and down, none, two of the RF, at each time.
        pub const SETTINGS: usize = TIMES * (2 * CORRECTORS + 3);
        /// The monitors at each time, and the two tunes.
        pub const CHANNELS: usize = TIMES * MONITORS + 2;
        /// Entries of the lower triangle of a covariance of the channels.
        pub const COUPLINGS: usize = CHANNELS * (CHANNELS + 1) / 2;
        /// Words of 32 bits with a bit for each monitor or param.
        pub const WORDS: usize = $crate::words($crate::largest(&[MONITORS, PARAMS]));
        /// All these numbers.
        pub const SIZES: $crate::Sizes =
            $crate::Sizes::new(MONITORS_BY_PLANE, CORRECTORS_BY_PLANE, [QUADRUPOLES, PARAMS, SUPPLIES]);
        /// Entries of the longest line of the tables.
        pub const LINE: usize =
            $crate::largest(&[NODES, PARAMS, MONITORS, CORRECTORS, $crate::surrogate::TERMS, $crate::surrogate::RING]);
        /// Bytes that hold any packet.
        pub const PACKET: usize = $crate::packet::wire_bytes($crate::largest(&[
            Frame::MAX_BYTES,
            Answer::MAX_BYTES,
            $crate::wire::link::Short::<Setpoints>::MAX_BYTES,
            Setup::MAX_BYTES,
            Feedback::MAX_BYTES,
            Parcel::MAX_BYTES,
            $crate::wire::link::OTHER_BYTES,
        ]));

        /// Its Green's function.
        pub type Green = $crate::surrogate::Green<
            { $monitors_x },
            { $monitors_y },
            { $correctors_x },
            { $correctors_y },
            QUADRUPOLES,
            PARAMS,
            NODES,
            PAIRS,
        >;
        /// Its core.
        pub type Estimator = $crate::Estimator<
            Green,
            MONITORS,
            CORRECTORS,
            SUPPLIES,
            PARAMS,
            SETTINGS,
            CHANNELS,
            TRIANGLE,
            COUPLINGS,
            WORDS,
        >;
        /// The feedback on it.
        pub type Steer = $crate::Steer<
            MONITORS,
            CORRECTORS,
            { $correctors_x },
            { $correctors_y },
            { $correctors_x * ($correctors_x + 1) / 2 },
            { $correctors_y * ($correctors_y + 1) / 2 },
        >;
        /// What is wanted of its orbit.
        pub type Feedback = $crate::Feedback<MONITORS, CORRECTORS>;
        /// One of its cycles.
        pub type Frame = $crate::Frame<MONITORS, CORRECTORS, SUPPLIES, WORDS>;
        /// What drives its beam.
        pub type Drive = $crate::Drive<CORRECTORS, SUPPLIES>;
        /// What its surrogate predicts.
        pub type Prediction = $crate::Prediction<MONITORS, SUPPLIES, PARAMS>;
        /// Its setup: priors, noise, calibration.
        pub type Setup = $crate::Setup<MONITORS, CORRECTORS, SUPPLIES>;
        /// Its estimate after a frame.
        pub type Estimate = $crate::Estimate<MONITORS, PARAMS, WORDS>;
        /// The same on the wire.
        pub type Answer = $crate::wire::link::Answer<MONITORS, PARAMS, WORDS>;
        /// A part of its tables.
        pub type Parcel = $crate::Parcel<LINE>;
        /// A request of its host.
        pub type Request = $crate::wire::link::Request<Setup, Parcel, Feedback>;
        /// Setpoints of its correctors.
        pub type Setpoints = $crate::wire::link::Setpoints<CORRECTORS>;
        /// A reply of its device.
        pub type Reply = $crate::wire::link::Reply<Answer, Setpoints>;
    };
}
