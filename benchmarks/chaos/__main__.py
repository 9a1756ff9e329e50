"""`python -m benchmarks.chaos`."""

from benchmarks.chaos.benchmark import main

if __name__ == "__main__":
    main()
