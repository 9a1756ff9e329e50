"""`python -m benchmarks.servo`."""

from benchmarks.servo.benchmark import main

if __name__ == "__main__":
    main()
