"""What several tests share: toys, small configurations, servers."""
