"""The controls gateway: orbitcal's estimates, read from shared memory, as EPICS records and one NTTable."""
