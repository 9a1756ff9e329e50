"""`python -m benchmarks.appearance`."""

from benchmarks.appearance.benchmark import main

if __name__ == "__main__":
    main()
