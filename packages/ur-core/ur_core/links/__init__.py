"""Client connections to a UR controller: RTDE (read-only), dashboard and primary interface; and to JSON services.

Also the status of an arm and the estimate of its controller's clock. Nothing here commands motion.
"""
