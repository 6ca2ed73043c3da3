"""The HTML shell that compare, discover and live share: blocks, numbers, plot style, one offline file."""
