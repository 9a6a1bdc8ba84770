"""What a sweep's runs say, in numbers and words: the one place, whoever asks. Knows no Ray."""
