"""Episodes as rosbag2 folders: writer, reader and replay."""
