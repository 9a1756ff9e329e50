"""`python -m benchmarks.fit_belief`."""

from benchmarks.fit_belief.benchmark import main

if __name__ == "__main__":
    main()
