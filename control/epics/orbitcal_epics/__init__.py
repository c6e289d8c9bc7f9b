"""EPICS for orbitcal: the client that `orbitcal measure` starts, the live source of the daemon, what carries set points to the machine, and a soft IOC with a simulated machine."""
