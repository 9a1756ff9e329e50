"""`python -m benchmarks.ekf_speed`."""

from benchmarks.ekf_speed.benchmark import main

if __name__ == "__main__":
    main()
