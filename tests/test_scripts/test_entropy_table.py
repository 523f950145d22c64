"""The script that tells estimates' bias."""

from scripts import entropy_table


def test_the_table_has_every_estimate():
    found = list(entropy_table.rows(entropy_table.Options(sets=20, count=50)))
    lines = entropy_table.markdown(found).splitlines()
    cells = {line.split("|")[1].strip(): [c.split()[0] for c in line.split("|")[2:-1]] for line in lines[2:]}
    assert set(cells) == {"spatial", "spatial, without itself", "spatial, geometric mean", "kernel", "neighbour"}
    # the estimate from neighbours' distances is nearly right on a line
    assert abs(float(cells["neighbour"][0])) < 0.1
    # and boxes without the state itself are wider
    assert all(float(a) < float(b) for a, b in zip(cells["spatial"], cells["spatial, without itself"], strict=True))
