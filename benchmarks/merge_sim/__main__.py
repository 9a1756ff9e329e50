"""`python -m benchmarks.merge_sim`."""

from benchmarks.merge_sim.benchmark import main

if __name__ == "__main__":
    main()
