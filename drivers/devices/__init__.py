"""The devices of a stand, each over its wire: what they read, do, and how they are made safe."""
