"""Evaluate trained methods, under a stated protocol for each kind of dataset."""

from .run import claim_evaluation as claim_evaluation
from .run import evaluate_collection as evaluate_collection
from .run import evaluate_on as evaluate_on
from .run import evaluate_run as evaluate_run
from .run import stem as stem
from .shapes import ShapesEvaluation as ShapesEvaluation
from .shapes import evaluate_shapes as evaluate_shapes
from .views import ViewScore as ViewScore
from .views import ViewsEvaluation as ViewsEvaluation
from .views import compare as compare
from .views import evaluate as evaluate
from .views import file_name as file_name
from .walks import evaluate_walk as evaluate_walk
from .walks import warped_difference as warped_difference
