"""`python -m benchmarks.liar`."""

from benchmarks.liar.benchmark import main

if __name__ == "__main__":
    main()
