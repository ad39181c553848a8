"""What controllers are made of: prediction, scenario trees and their quadratic programs, compilation, the critic's derivatives."""
