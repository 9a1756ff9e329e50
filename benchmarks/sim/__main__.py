"""`python -m benchmarks.sim`."""

from benchmarks.sim.benchmark import main

if __name__ == "__main__":
    main()
