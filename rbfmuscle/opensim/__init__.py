"""What is read from and written for OpenSim: models in, muscle paths out."""

from rbfmuscle.sim.scene.scene import IMPORTERS


def _read(path, **options):
    from rbfmuscle.opensim.scene import import_osim

    return import_osim(path, **options).scene


IMPORTERS["osim"] = _read
