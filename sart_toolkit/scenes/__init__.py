"""A scene as data: bodies, joints, cameras and light."""
