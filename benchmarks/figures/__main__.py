"""`python -m benchmarks.figures`."""

from benchmarks.figures.benchmark import main

if __name__ == "__main__":
    main()
