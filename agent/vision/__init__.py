"""The front end: SIFT features on nodes, Lucas-Kanade tracks on every frame."""
