"""The robot's body: tools and grippers, arms, what they reach, and how long motions take."""
