"""`python -m benchmarks.ekf`."""

from benchmarks.ekf.benchmark import main

if __name__ == "__main__":
    main()
