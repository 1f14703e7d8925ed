"""The verdict on a motor at work: what healthy windows of its logs teach, each window, and looks before it ends."""
