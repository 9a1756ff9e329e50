"""`python -m benchmarks.life`."""

from benchmarks.life.benchmark import main

if __name__ == "__main__":
    main()
