"""All vars as one NTTable on PVA."""

from p4p.nt import NTTable
from p4p.server import Server
from p4p.server.thread import SharedPV

from . import severity


class Table:
    """`PREFIX:TABLE`: name, mean, sigma and severity of every var."""

    def __init__(self, name):
        self.type = NTTable(columns=[("name", "s"), ("mean", "d"), ("sigma", "d"), ("severity", "i")])
        self.pv = SharedPV(nt=self.type, initial=[])
        self.server = Server(providers=[{name: self.pv}])

    def show(self, config, estimate):
        def row(i):
            worst = severity.of_row(config, estimate, i)
            return {"name": estimate.vars[i], "mean": estimate.mean[i], "sigma": estimate.sigma[i], "severity": worst}

        self.pv.post([row(i) for i in range(len(estimate.vars))], timestamp=estimate.published_s)

    def stop(self):
        self.server.stop()
