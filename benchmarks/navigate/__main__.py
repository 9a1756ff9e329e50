"""`python -m benchmarks.navigate`."""

from benchmarks.navigate.benchmark import main

if __name__ == "__main__":
    main()
