"""`python -m benchmarks.life_sim`."""

from benchmarks.life_sim.benchmark import main

if __name__ == "__main__":
    main()
