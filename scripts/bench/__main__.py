"""`python -m scripts.bench`."""

from rumi.cli import script
from scripts.bench.command import bench

if __name__ == "__main__":
    script(bench)
