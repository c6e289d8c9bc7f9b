"""EPICS for orbitcal: the client that `orbitcal measure` starts, and a soft IOC with a simulated machine behind it."""
